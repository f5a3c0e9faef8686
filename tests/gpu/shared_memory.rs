//! Memory that OpenGL and CUDA share: pictures that the copy engine moves to the host, and vertices that OpenGL
//! imports. Frames equal those without shared memory, also with several steps and frames in flight.

use std::cell::Cell;
use std::collections::VecDeque;
use std::rc::Rc;
use std::sync::Arc;
use std::time::{Duration, Instant};

use modalcast::frame::encode_png;
use modalcast_compute::gpu::{CudaDeformer, CudaDeformerOptions, CudaPictureMemory, Device};
use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::deform::Deformer;
use modalcast_model::error::Result;
use modalcast_model::raster::GlVertexBuffers;
use modalcast_model::scene::{BoundingBox, Camera, Scene, SceneState};
use modalcast_model::shared_memory::{ExportedVertices, ImportedVertices, VertexImporter};
use modalcast_render::{
    FrameParams, FramePixels, MAX_FRAMES_IN_FLIGHT, PendingFrame, PixelReadback, Renderer, SceneBuffers,
};

use crate::gl::Exclusive;
use crate::scenes;

/// A renderer, a scene with normal maps, and the images of its states without shared memory.
struct Fixture {
    renderer: Exclusive<Renderer>,
    device: Arc<Device>,
    scene: Arc<Scene>,
    states: Vec<Arc<SceneState>>,
    size: [u32; 2],
    expected_images: Vec<Vec<u8>>,
}

impl Fixture {
    /// Draws the images from uploaded vertices through pixel buffers. Then lets the renderer share memory with CUDA.
    fn open(size: [u32; 2], states: u64) -> Self {
        let mut renderer = Exclusive::renderer();
        let device = Device::open(0).expect("expected a CUDA device");
        let options = scenes::RandomSceneOptions { instances: 5, normal_maps: true, rigid_transforms: false };
        let scene = scenes::random_scene(&[(3000, 12), (50, 0), (7, 3)], options);
        let states: Vec<Arc<SceneState>> =
            (0..states).map(|seed| Arc::new(scenes::random_state(&scene, seed))).collect();
        let mut deformer = open_deformer(&device, &scene, None);
        let buffers = renderer.load(&scene).expect("expected the scene to load");
        assert!(matches!(renderer.info().pixel_readback, PixelReadback::PixelBuffer(_)));
        assert!(buffers.vertex_buffers().importer.is_none());
        let mut draw = |state: &Arc<SceneState>| {
            let bounds = deformer.deform(state).expect("expected the step to succeed").bounds;
            renderer.upload(&buffers, deformer.surface().expect("expected a surface")).expect("expected an upload");
            renderer.draw(&buffers, &frame_params(&scene, size, bounds)).expect("expected a frame").rgba
        };
        let expected_images: Vec<Vec<u8>> = states.iter().map(&mut draw).collect();
        assert!(expected_images.windows(2).all(|pair| pair[0] != pair[1]), "expected different images");
        renderer.unload(buffers);
        let memory = CudaPictureMemory::new(&device).expect("expected a copy stream");
        renderer.share_pictures(Rc::new(memory)).expect("expected no lost device");
        assert_eq!(renderer.info().pixel_readback, PixelReadback::CopyEngine);
        Self { renderer, device, scene, states, size, expected_images }
    }

    /// [`Self::draw_steps_with_next`] without steps ahead.
    fn draw_steps(
        &mut self,
        seconds: f64,
        change_buffers: impl FnOnce(GlVertexBuffers) -> GlVertexBuffers,
    ) -> FrameCounts {
        self.draw_steps_with_next(seconds, change_buffers, |_| None)
    }

    /// Deforms and draws steps with [`MAX_FRAMES_IN_FLIGHT`] frames in flight for at least `seconds` and two rounds of
    /// the states. `next` returns the index of the state that the deformer may compute with that of a step.
    /// `change_buffers` changes the buffers that the deformer gets. Returns the numbers of frames and of frames that
    /// show another image than that of their step.
    fn draw_steps_with_next(
        &mut self,
        seconds: f64,
        change_buffers: impl FnOnce(GlVertexBuffers) -> GlVertexBuffers,
        next: impl Fn(usize) -> Option<usize>,
    ) -> FrameCounts {
        let buffers = self.renderer.load(&self.scene).expect("expected the scene to load");
        let vertex_buffers = buffers.vertex_buffers();
        assert!(vertex_buffers.importer.is_some());
        let mut deformer = open_deformer(&self.device, &self.scene, Some(change_buffers(vertex_buffers)));
        let mut counts = FrameCounts::default();
        let mut frames: VecDeque<(usize, PendingFrame)> = VecDeque::new();
        let begin = Instant::now();
        let mut step = 0;
        while step < 2 * self.states.len() || begin.elapsed() < Duration::from_secs_f64(seconds) {
            let index = step % self.states.len();
            let next_state = next(step).map(|next| Arc::clone(&self.states[next % self.states.len()]));
            self.submit(&mut deformer, &buffers, (index, next_state), &mut frames);
            if next(step).is_some() && step % 16 == 5 {
                // A readback shows the same step, also if the next one is already computed.
                let mut reference = ReferenceDeformer::new(&self.scene);
                reference.deform(&self.states[index]).expect("expected a reference");
                let (expected, got) = (reference.surface(), deformer.surface());
                let expected = &expected.expect("expected positions").positions;
                let got = &got.expect("expected positions").positions;
                let is_close = |(a, b): (&f32, &f32)| (a - b).abs() < 1e-3;
                assert!(expected.len() == got.len() && expected.iter().zip(got).all(is_close), "step {step}");
            }
            while frames.len() >= MAX_FRAMES_IN_FLIGHT {
                self.finish_oldest(&mut frames, &mut counts);
            }
            step += 1;
        }
        while !frames.is_empty() {
            self.finish_oldest(&mut frames, &mut counts);
        }
        drop(deformer);
        self.renderer.unload(buffers);
        counts
    }

    /// Draws each state once with the PNG file. Returns the numbers of files and of files that differ from those of the
    /// CPU.
    fn encode_steps(&mut self, copies_pixels: bool) -> FrameCounts {
        let buffers = self.renderer.load(&self.scene).expect("expected the scene to load");
        let mut deformer = open_deformer(&self.device, &self.scene, Some(buffers.vertex_buffers()));
        let mut counts = FrameCounts::default();
        let mut frames: VecDeque<(usize, PendingFrame)> = VecDeque::new();
        for index in 0..self.states.len() {
            self.submit(&mut deformer, &buffers, (index, None), &mut frames);
            frames[0].1.request_png(copies_pixels);
            let (_, frame) = frames.pop_front().expect("expected a frame");
            let pixels = self.renderer.map_pixels(frame).expect("expected a frame").into_shared_image().rgba;
            let FramePixels::Encoded(encoded) = &pixels else { panic!("expected a file") };
            let rgba = &self.expected_images[index];
            let expected_file = encode_png(self.size[0], self.size[1], rgba).expect("expected a PNG");
            assert_eq!(pixels.as_ref(), if copies_pixels { &rgba[..] } else { &[] });
            counts.all += 1;
            counts.stale += usize::from(encoded.png != expected_file);
        }
        drop(deformer);
        self.renderer.unload(buffers);
        counts
    }

    fn submit(
        &mut self,
        deformer: &mut CudaDeformer,
        buffers: &SceneBuffers,
        (index, next): (usize, Option<Arc<SceneState>>),
        frames: &mut VecDeque<(usize, PendingFrame)>,
    ) {
        next.iter().for_each(|next| deformer.announce(next));
        let deformed = deformer.deform(&self.states[index]);
        let bounds = deformed.expect("expected the step to succeed").bounds;
        deformer.fill_gl_buffers().expect("expected filled buffers");
        let params = frame_params(&self.scene, self.size, bounds);
        frames.push_back((index, self.renderer.submit(buffers, &params).expect("expected the frame to start")));
    }

    fn finish_oldest(&mut self, frames: &mut VecDeque<(usize, PendingFrame)>, counts: &mut FrameCounts) {
        let Some((index, frame)) = frames.pop_front() else { return };
        let pixels = self.renderer.map_pixels(frame).expect("expected a frame").into_shared_image().rgba;
        counts.all += 1;
        counts.stale += usize::from(pixels.as_ref() != self.expected_images[index]);
    }
}

#[derive(Debug, Default, PartialEq, Eq)]
struct FrameCounts {
    all: usize,
    stale: usize,
}

fn frame_params(scene: &Scene, [width, height]: [u32; 2], bounds: BoundingBox) -> FrameParams {
    FrameParams {
        camera: Camera::fit_to_scene(scene, 64, 64),
        width,
        height,
        bounds,
        light_bounds: None,
        edges: None,
        samples: None,
    }
}

fn open_deformer(device: &Arc<Device>, scene: &Arc<Scene>, buffers: Option<GlVertexBuffers>) -> CudaDeformer {
    let options = CudaDeformerOptions::with_bounding_axes(scene.light_axes());
    CudaDeformer::new(device, scene, buffers, options).expect("expected a CUDA deformer")
}

/// Seconds of the long test; MODALCAST_PIPELINE_SECONDS overrides the default.
fn pipeline_seconds() -> f64 {
    std::env::var("MODALCAST_PIPELINE_SECONDS").ok().and_then(|text| text.parse().ok()).unwrap_or(5.0)
}

/// Steps and small frames without a pause, through shared vertices and shared pictures.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_pipelined_steps_show_no_stale_frame() {
    let mut fixture = Fixture::open([96, 64], 24);
    let counts = fixture.draw_steps(pipeline_seconds(), |buffers| buffers);
    eprintln!("{counts:?} small frames with shared vertices");
    assert!(counts.all > 0 && counts.stale == 0, "{counts:?}");
}

/// Frames that take longer than a step, so that the deformer writes vertices while earlier frames are drawn.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_large_frames_in_flight_keep_their_vertices_and_pixels() {
    let mut fixture = Fixture::open([1920, 1080], 24);
    let counts = fixture.draw_steps(0.0, |buffers| buffers);
    assert_eq!(counts, FrameCounts { all: 48, stale: 0 });
    // Without an importer, CUDA maps OpenGL's buffers.
    let mapped_counts = fixture.draw_steps(0.0, |buffers| GlVertexBuffers { importer: None, ..buffers });
    assert_eq!(mapped_counts, counts);
}

/// An importer that refuses all memory.
#[derive(Debug)]
struct RefusingImporter;

impl VertexImporter for RefusingImporter {
    fn import(&self, _: ExportedVertices) -> Result<Box<dyn ImportedVertices>> {
        Err(modalcast_model::error::fault("test", "refused"))
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_buffers_are_mapped_if_the_import_is_refused() {
    let mut fixture = Fixture::open([320, 240], 24);
    let counts =
        fixture.draw_steps(0.0, |buffers| GlVertexBuffers { importer: Some(Rc::new(RefusingImporter)), ..buffers });
    assert_eq!(counts, FrameCounts { all: 48, stale: 0 });
}

/// An importer whose vertices reach the scene only at every second step.
#[derive(Debug)]
struct OmittingImporter(Rc<dyn VertexImporter>);

#[derive(Debug)]
struct OmittingVertices {
    inner: Box<dyn ImportedVertices>,
    steps: Cell<u32>,
}

impl VertexImporter for OmittingImporter {
    fn import(&self, vertices: ExportedVertices) -> Result<Box<dyn ImportedVertices>> {
        Ok(Box::new(OmittingVertices { inner: self.0.import(vertices)?, steps: Cell::new(0) }))
    }
}

impl ImportedVertices for OmittingVertices {
    fn copy_to_scene(&self) -> Result<()> {
        let step = self.steps.replace(self.steps.get() + 1);
        if step.is_multiple_of(2) { self.inner.copy_to_scene() } else { Ok(()) }
    }

    fn is_copied(&self) -> bool {
        self.inner.is_copied()
    }

    fn wait_for_copy(&self) -> Result<()> {
        self.inner.wait_for_copy()
    }
}

/// Control of the tests above: they notice frames that show the vertices of another step.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_frames_of_steps_that_are_not_copied_are_found_stale() {
    let mut fixture = Fixture::open([320, 240], 24);
    let counts = fixture.draw_steps(0.0, |buffers| {
        let importer = buffers.importer.expect("expected an importer");
        GlVertexBuffers { importer: Some(Rc::new(OmittingImporter(importer))), ..buffers }
    });
    assert!(counts.stale > 0 && counts.stale < counts.all, "{counts:?}");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_frames_have_the_png_of_the_cpu() {
    for size in [[640, 360], [333, 111]] {
        let mut fixture = Fixture::open(size, 5);
        for copies_pixels in [false, true] {
            assert_eq!(fixture.encode_steps(copies_pixels), FrameCounts { all: 5, stale: 0 }, "{size:?}");
        }
        // Frames without the request are not affected by earlier requests.
        assert_eq!(fixture.draw_steps(0.1, |buffers| buffers).stale, 0);
    }
}

/// Two steps are computed at once. The frames show the step that was deformed last, also if the next step is not the
/// announced one.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_frames_of_steps_ahead_are_not_stale() {
    let mut fixture = Fixture::open([640, 360], 7);
    let always = fixture.draw_steps_with_next(3.0, |buffers| buffers, |step| Some(step + 1));
    assert!(always.stale == 0 && always.all >= 10, "{always:?}");
    let wrong_sometimes = |step: usize| Some(if step % 5 == 3 { step + 2 } else { step + 1 });
    let mixed = fixture.draw_steps_with_next(3.0, |buffers| buffers, wrong_sometimes);
    assert!(mixed.stale == 0 && mixed.all >= 10, "{mixed:?}");
}
