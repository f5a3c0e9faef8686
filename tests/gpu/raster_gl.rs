//! The compute rasterizer on OpenGL buffers, compared with its definition.

use std::sync::Arc;

use modalcast_compute::gpu::{CudaDeformer, CudaRasterizer, Device};
use modalcast_compute::reference::raster::VisibilityBuffer;
use modalcast_model::deform::Deformer as _;
use modalcast_model::raster::{CutOuts, GlBuffer, RasterGeometry, Rasterizer};
use modalcast_model::scene::{CullMode, DrawRange, Viewport};

use crate::both::cut_outs::plain_holes;
use crate::both::soups::{Soup, flat, soups};
use crate::gl::Gl;
use crate::scenes;

/// A CUDA device and an OpenGL context on it.
struct Stage {
    device: Arc<Device>,
    gl: Gl,
}

impl Stage {
    fn open() -> Self {
        let gl = Gl::open();
        Self { device: Device::open(0).expect("a CUDA device"), gl }
    }

    fn raster(&self, soup: &Soup, cut_outs: Option<CutOuts>) -> (CudaRasterizer, GlBuffer) {
        let positions = self.gl.filled(&soup.positions);
        let mesh = mesh(positions.clone(), soup, cut_outs);
        (CudaRasterizer::new(&self.device, mesh).expect("a rasteriser"), positions)
    }

    fn ids(&self, raster: &mut CudaRasterizer, window: &Viewport, into: &GlBuffer) -> Vec<u64> {
        raster.draw(None, Some((window, into))).expect("draws");
        self.gl.read(into, window.pixel_count())
    }

    /// Depths as bits.
    fn depth(&self, raster: &mut CudaRasterizer, window: &Viewport, into: &GlBuffer) -> Vec<u32> {
        raster.draw(Some((window, into)), None).expect("draws");
        self.gl.read(into, window.pixel_count())
    }
}

fn mesh(positions: GlBuffer, soup: &Soup, cut_outs: Option<CutOuts>) -> RasterGeometry {
    RasterGeometry { positions, triangles: soup.triangles.clone(), groups: soup.groups.clone(), cut_outs }
}

/// Depths of all triangles with both faces, as in a depth-only pass.
fn from_both_sides(soup: &Soup, cut_outs: Option<&CutOuts>) -> Vec<u32> {
    let mut raster = VisibilityBuffer::new(soup.window);
    let all = DrawRange { first: 0, triangles: soup.triangles.len() as u32, faces: CullMode::None };
    match cut_outs {
        Some(cut_outs) => raster.draw_cut_out(&soup.positions, &soup.triangles, all, cut_outs),
        None => raster.draw(&soup.positions, &soup.triangles, all),
    }
    raster.depths().into_iter().map(f32::to_bits).collect()
}

fn differing<T: PartialEq>(got: &[T], want: &[T]) -> usize {
    assert_eq!(got.len(), want.len());
    got.iter().zip(want).filter(|(got, want)| got != want).count()
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_samples_have_the_bits_of_the_definition() {
    let stage = Stage::open();
    let mut backs = 0;
    for soup in soups() {
        let (mut raster, positions) = stage.raster(&soup, None);
        let pixel_count = soup.window.pixel_count() as u64;
        let (keys, depths) = (stage.gl.room(8 * pixel_count), stage.gl.room(4 * pixel_count));
        let (want, want_depths) = (soup.drawn(), from_both_sides(&soup, None));
        backs += differing(&want_depths, &want.depths().into_iter().map(f32::to_bits).collect::<Vec<_>>());
        for run in 0..3 {
            let got = stage.ids(&mut raster, &soup.window, &keys);
            assert_eq!(differing(&got, &want.keys), 0, "{}, run {run}", soup.name);
            let got = stage.depth(&mut raster, &soup.window, &depths);
            assert_eq!(differing(&got, &want_depths), 0, "{}, depth, run {run}", soup.name);
        }
        drop(raster);
        drop((positions, keys, depths));
    }
    assert!(backs > 1000, "control: {backs} samples see a back in depth alone");
}

/// In the id pass and in the depth pass.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_uniform_cut_outs_have_the_bits_of_the_definition() {
    let stage = Stage::open();
    for holes in plain_holes() {
        let soup = &holes.soup;
        let (mut raster, _) = stage.raster(soup, Some(holes.cut_outs.clone()));
        let pixel_count = soup.window.pixel_count() as u64;
        let got = stage.ids(&mut raster, &soup.window, &stage.gl.room(8 * pixel_count));
        assert_eq!(differing(&got, &holes.drawn().keys), 0, "{}", soup.name);
        let got = stage.depth(&mut raster, &soup.window, &stage.gl.room(4 * pixel_count));
        assert_eq!(differing(&got, &from_both_sides(soup, Some(&holes.cut_outs))), 0, "{}, depth", soup.name);
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_positions_written_by_opengl_need_no_wait() {
    let stage = Stage::open();
    let mut soup = soups().into_iter().find(|soup| soup.name == "a few pixels").expect("there");
    let (mut raster, positions) = stage.raster(&soup, None);
    let keys = stage.gl.room(8 * soup.window.pixel_count() as u64);
    let mut before = Vec::new();
    for step in 0..20 {
        soup.positions
            .iter_mut()
            .enumerate()
            .for_each(|(at, number)| *number += 0.01 * ((at + step) % 7) as f32 - 0.03);
        stage.gl.write(&positions, &soup.positions);
        let got = stage.ids(&mut raster, &soup.window, &keys);
        assert_eq!(differing(&got, &soup.drawn().keys), 0, "step {step}");
        assert!(got != before, "the judge can fail");
        before = got;
    }
}

/// OpenGL may give a new target the name of a deleted one.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_targets_may_be_resized_and_reuse_buffer_names() {
    let stage = Stage::open();
    let mut soup = soups().into_iter().find(|soup| soup.name == "large").expect("there");
    let (mut raster, _) = stage.raster(&soup, None);
    for (width, height) in [(64, 64), (640, 480), (640, 480), (33, 7), (1, 1), (640, 480)] {
        soup.window = flat(width, height);
        let keys = stage.gl.room(8 * soup.window.pixel_count() as u64);
        let want = soup.drawn();
        for _ in 0..2 {
            assert_eq!(differing(&stage.ids(&mut raster, &soup.window, &keys), &want.keys), 0, "{width} x {height}");
        }
    }
    // Targets larger than needed, and two targets that alternate without being forgotten.
    let list = [0, 100].map(|more| stage.gl.room(8 * soup.window.pixel_count() as u64 + more));
    for keys in [&list[0], &list[1], &list[0], &list[1]] {
        stage.gl.write(keys, &vec![0_u64; soup.window.pixel_count()]);
        assert_eq!(differing(&stage.ids(&mut raster, &soup.window, keys), &soup.drawn().keys), 0);
    }
}

/// The rasterizer stays usable afterwards.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_unknown_or_small_buffers_are_refused() {
    let stage = Stage::open();
    let soup = soups().into_iter().find(|soup| soup.name == "a few pixels").expect("there");
    let pixel_count = soup.window.pixel_count() as u64;
    let unknown = |bytes| stage.gl.handle(999_999, bytes);
    let refused = CudaRasterizer::new(&stage.device, mesh(unknown(4 * soup.positions.len() as u64), &soup, None));
    assert!(refused.expect_err("unknown").to_string().contains("999999"));
    let (mut raster, positions) = stage.raster(&soup, None);
    raster.draw(None, Some((&soup.window, &unknown(8 * pixel_count)))).expect_err("unknown");
    let small = stage.gl.room(4 * pixel_count);
    raster.draw(None, Some((&soup.window, &small))).expect_err("too small, and it says so");
    raster
        .draw(None, Some((&soup.window, &GlBuffer { bytes: 8 * pixel_count, ..small.clone() })))
        .expect_err("smaller than it says");
    let fewer = GlBuffer { bytes: 3 * 4 * 2, ..positions };
    CudaRasterizer::new(&stage.device, mesh(fewer, &soup, None)).expect_err("vertices that are not there");
    let keys = stage.gl.room(8 * pixel_count);
    assert_eq!(differing(&stage.ids(&mut raster, &soup.window, &keys), &soup.drawn().keys), 0, "after refusals");
    assert_eq!(differing(&stage.depth(&mut raster, &soup.window, &small), &from_both_sides(&soup, None)), 0);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_positions_shared_with_a_deformer_are_drawn() {
    let mut stage = Stage::open();
    let scene = scenes::scene(&[(3000, 12), (50, 0), (7, 3)], 5, true, false);
    let buffers = stage.gl.renderer.load(&scene).expect("loads");
    let shared = buffers.vertex_buffers().expect("buffers");
    let positions = shared.positions.clone();
    let mut deformer = CudaDeformer::new(&stage.device, &scene, Some(shared)).expect("a deformer");
    assert!(deformer.shares_buffers(), "interop was refused");
    let list = scene.triangle_vertices();
    let all = DrawRange { first: 0, triangles: list.len() as u32, faces: CullMode::None };
    let mesh = RasterGeometry { positions, triangles: list.clone(), groups: vec![all], cut_outs: None };
    let mut raster = CudaRasterizer::new(&stage.device, mesh).expect("a buffer that is registered twice");
    let window = flat(300, 200);
    let keys = stage.gl.room(8 * window.pixel_count() as u64);
    for seed in 0..10 {
        deformer.deform(&scenes::state(&scene, seed)).expect("deforms");
        let got = stage.ids(&mut raster, &window, &keys);
        let mut want = VisibilityBuffer::new(window);
        want.draw(&deformer.surface().expect("copies").positions, &list, all);
        assert_eq!(differing(&got, &want.keys), 0, "step {seed}");
        assert!(got.iter().any(|key| *key != u64::MAX), "something is seen");
    }
    drop((raster, deformer));
    stage.gl.renderer.unload(buffers);
}
