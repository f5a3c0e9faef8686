//! The CUDA rasterizer on OpenGL buffers, compared with the reference rasterizer. A soup is a list of triangles that
//! are hard to rasterize, with a viewport. `CudaRasterizer::draw` takes the target of the depth pass, then the target
//! of the id pass; each may be `None`.

use std::sync::Arc;

use modalcast_compute::gpu::{CudaDeformer, CudaDeformerOptions, CudaRasterizer, Device};
use modalcast_compute::reference::raster::VisibilityBuffer;
use modalcast_model::deform::Deformer as _;
use modalcast_model::raster::{ALL_TRIANGLES, CutOuts, GlBuffer, RasterGeometry, Rasterizer};
use modalcast_model::scene::{CullMode, DrawRange, Viewport};

use crate::common::cut_outs::constant_alpha_soups;
use crate::common::soups::{Soup, all_soups, clip_space_viewport};
use crate::gl::GlContext;
use crate::scenes;

/// A CUDA device and an OpenGL context on it.
struct GpuContext {
    device: Arc<Device>,
    gl: GlContext,
}

impl GpuContext {
    fn open() -> Self {
        let gl = GlContext::open();
        Self { device: Device::open(0).expect("expected a CUDA device"), gl }
    }

    fn create_rasterizer(&self, soup: &Soup, cut_outs: Option<CutOuts>) -> (CudaRasterizer, GlBuffer) {
        let positions = self.gl.create_buffer_from(&soup.positions);
        let geometry = soup_geometry(positions.clone(), soup, cut_outs);
        (CudaRasterizer::new(&self.device, geometry).expect("expected a rasterizer"), positions)
    }

    /// The key of each sample: the inverted bits of its depth in the upper half, the index of its triangle in the lower
    /// half.
    fn draw_ids(&self, rasterizer: &mut CudaRasterizer, viewport: &Viewport, target: &GlBuffer) -> Vec<u64> {
        rasterizer.draw(None, Some((viewport, target)), ALL_TRIANGLES).expect("expected a frame");
        self.gl.read(target, viewport.pixel_count())
    }

    /// The bits of the depth of each sample, without culling.
    fn draw_depths(&self, rasterizer: &mut CudaRasterizer, viewport: &Viewport, target: &GlBuffer) -> Vec<u32> {
        rasterizer.draw(Some((viewport, target)), None, ALL_TRIANGLES).expect("expected a frame");
        self.gl.read(target, viewport.pixel_count())
    }
}

fn soup_geometry(positions: GlBuffer, soup: &Soup, cut_outs: Option<CutOuts>) -> RasterGeometry {
    RasterGeometry { positions, triangles: soup.triangles.clone(), groups: soup.groups.clone(), cut_outs }
}

/// The bits of the depths that the reference rasterizer draws without culling, as in a depth-only pass.
fn two_sided_depths(soup: &Soup, cut_outs: Option<&CutOuts>) -> Vec<u32> {
    let mut rasterizer = VisibilityBuffer::new(soup.viewport);
    let all_triangles =
        DrawRange { first_triangle: 0, triangle_count: soup.triangles.len() as u32, cull_mode: CullMode::None };
    match cut_outs {
        Some(cut_outs) => rasterizer.draw_cut_out(&soup.positions, &soup.triangles, all_triangles, cut_outs),
        None => rasterizer.draw(&soup.positions, &soup.triangles, all_triangles),
    }
    rasterizer.depths().into_iter().map(f32::to_bits).collect()
}

/// Number of items that differ.
fn count_differences<T: PartialEq>(got: &[T], want: &[T]) -> usize {
    assert_eq!(got.len(), want.len());
    got.iter().zip(want).filter(|(got, want)| got != want).count()
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_samples_have_the_bits_of_the_reference() {
    let context = GpuContext::open();
    let mut back_faces = 0;
    for soup in all_soups() {
        let (mut rasterizer, positions) = context.create_rasterizer(&soup, None);
        let pixel_count = soup.viewport.pixel_count() as u64;
        // A sample of ids has 8 bytes (depth and triangle), a sample of depth 4.
        let (id_target, depth_target) =
            (context.gl.create_buffer(8 * pixel_count), context.gl.create_buffer(4 * pixel_count));
        let (want, want_depths) = (soup.rasterize(), two_sided_depths(&soup, None));
        back_faces += count_differences(&want_depths, &want.depths().into_iter().map(f32::to_bits).collect::<Vec<_>>());
        for run in 0..3 {
            let got = context.draw_ids(&mut rasterizer, &soup.viewport, &id_target);
            assert_eq!(count_differences(&got, &want.keys), 0, "{}, run {run}", soup.name);
            let got = context.draw_depths(&mut rasterizer, &soup.viewport, &depth_target);
            assert_eq!(count_differences(&got, &want_depths), 0, "{}, depth, run {run}", soup.name);
        }
        let half = soup.triangles.len() as u32 / 2;
        for range in [0..half, half..ALL_TRIANGLES.end] {
            rasterizer.draw(None, Some((&soup.viewport, &id_target)), range).expect("expected a frame");
        }
        let got: Vec<u64> = context.gl.read(&id_target, soup.viewport.pixel_count());
        assert_eq!(count_differences(&got, &want.keys), 0, "{}, in two ranges", soup.name);
        // CUDA releases the buffers before OpenGL deletes them.
        drop(rasterizer);
        drop((positions, id_target, depth_target));
    }
    // The id pass culls the back faces of half of the triangles, the depth pass culls none. So the depths of the two
    // passes differ at the samples of culled back faces.
    assert!(back_faces > 1000, "control: expected more than 1000 samples of back faces, got {back_faces}");
}

/// Each image of these cut-outs has the same alpha at all texels. The test compares the id pass and the depth pass.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_uniform_cut_outs_have_the_bits_of_the_reference() {
    let context = GpuContext::open();
    for cut_out_soup in constant_alpha_soups() {
        let soup = &cut_out_soup.soup;
        let (mut rasterizer, _) = context.create_rasterizer(soup, Some(cut_out_soup.cut_outs.clone()));
        let pixel_count = soup.viewport.pixel_count() as u64;
        let got = context.draw_ids(&mut rasterizer, &soup.viewport, &context.gl.create_buffer(8 * pixel_count));
        assert_eq!(count_differences(&got, &cut_out_soup.rasterize().keys), 0, "{}", soup.name);
        let got = context.draw_depths(&mut rasterizer, &soup.viewport, &context.gl.create_buffer(4 * pixel_count));
        assert_eq!(
            count_differences(&got, &two_sided_depths(soup, Some(&cut_out_soup.cut_outs))),
            0,
            "{}, depth",
            soup.name
        );
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_positions_written_by_opengl_need_no_wait() {
    let context = GpuContext::open();
    let mut soup = all_soups().into_iter().find(|soup| soup.name == "a few pixels").expect("expected the named soup");
    let (mut rasterizer, positions) = context.create_rasterizer(&soup, None);
    let id_target = context.gl.create_buffer(8 * soup.viewport.pixel_count() as u64);
    let mut previous_keys = Vec::new();
    for step in 0..20 {
        // Moves each coordinate by -0.03 to 0.03.
        soup.positions
            .iter_mut()
            .enumerate()
            .for_each(|(index, number)| *number += 0.01 * ((index + step) % 7) as f32 - 0.03);
        context.gl.write(&positions, &soup.positions);
        let got = context.draw_ids(&mut rasterizer, &soup.viewport, &id_target);
        assert_eq!(count_differences(&got, &soup.rasterize().keys), 0, "step {step}");
        assert!(got != previous_keys, "step {step}: expected other samples than before");
        previous_keys = got;
    }
}

/// Targets may change their size, and OpenGL may give a new target the name of a deleted one.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_targets_may_be_resized_and_reuse_buffer_names() {
    let context = GpuContext::open();
    let mut soup = all_soups().into_iter().find(|soup| soup.name == "large").expect("expected the named soup");
    let (mut rasterizer, _) = context.create_rasterizer(&soup, None);
    for (width, height) in [(64, 64), (640, 480), (640, 480), (33, 7), (1, 1), (640, 480)] {
        soup.viewport = clip_space_viewport(width, height);
        let id_target = context.gl.create_buffer(8 * soup.viewport.pixel_count() as u64);
        let want = soup.rasterize();
        for _ in 0..2 {
            assert_eq!(
                count_differences(&context.draw_ids(&mut rasterizer, &soup.viewport, &id_target), &want.keys),
                0,
                "{width} x {height}"
            );
        }
    }
    // Two registered targets that alternate; one is larger than needed.
    let buffers =
        [0, 100].map(|extra_bytes| context.gl.create_buffer(8 * soup.viewport.pixel_count() as u64 + extra_bytes));
    for id_target in [&buffers[0], &buffers[1], &buffers[0], &buffers[1]] {
        context.gl.write(id_target, &vec![0_u64; soup.viewport.pixel_count()]);
        assert_eq!(
            count_differences(&context.draw_ids(&mut rasterizer, &soup.viewport, id_target), &soup.rasterize().keys),
            0,
            "alternating targets"
        );
    }
}

/// Unknown or small buffers return errors, and the rasterizer stays usable.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_unknown_or_small_buffers_return_errors() {
    let context = GpuContext::open();
    let soup = all_soups().into_iter().find(|soup| soup.name == "a few pixels").expect("expected the named soup");
    let pixel_count = soup.viewport.pixel_count() as u64;
    // OpenGL has no buffer of this name.
    let unknown_buffer = |bytes| context.gl.buffer_handle(999_999, bytes);
    let result = CudaRasterizer::new(
        &context.device,
        soup_geometry(unknown_buffer(4 * soup.positions.len() as u64), &soup, None),
    );
    assert!(result.expect_err("expected an unknown-buffer error").to_string().contains("999999"));
    let (mut rasterizer, positions) = context.create_rasterizer(&soup, None);
    rasterizer
        .draw(None, Some((&soup.viewport, &unknown_buffer(8 * pixel_count))), ALL_TRIANGLES)
        .expect_err("expected an unknown-buffer error");
    let small_target = context.gl.create_buffer(4 * pixel_count);
    rasterizer
        .draw(None, Some((&soup.viewport, &small_target)), ALL_TRIANGLES)
        .expect_err("expected an error for a target that is too small");
    rasterizer
        .draw(None, Some((&soup.viewport, &GlBuffer { bytes: 8 * pixel_count, ..small_target.clone() })), ALL_TRIANGLES)
        .expect_err("expected an error for a target smaller than its stated size");
    // The positions of two vertices.
    let too_few_positions = GlBuffer { bytes: 2 * size_of::<[f32; 3]>() as u64, ..positions };
    CudaRasterizer::new(&context.device, soup_geometry(too_few_positions, &soup, None))
        .expect_err("expected an error for vertices beyond the buffer");
    let id_target = context.gl.create_buffer(8 * pixel_count);
    assert_eq!(
        count_differences(&context.draw_ids(&mut rasterizer, &soup.viewport, &id_target), &soup.rasterize().keys),
        0,
        "after errors"
    );
    assert_eq!(
        count_differences(
            &context.draw_depths(&mut rasterizer, &soup.viewport, &small_target),
            &two_sided_depths(&soup, None)
        ),
        0
    );
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_positions_shared_with_a_deformer_are_drawn() {
    let mut context = GpuContext::open();
    let scene = scenes::random_scene(
        &[(3000, 12), (50, 0), (7, 3)],
        scenes::RandomSceneOptions { instances: 5, normal_maps: true, rigid_transforms: false },
    );
    let buffers = context.gl.renderer.load(&scene).expect("expected the scene to load");
    let shared = buffers.vertex_buffers();
    let positions = shared.positions.clone();
    let mut deformer = CudaDeformer::new(
        &context.device,
        &scene,
        Some(shared),
        CudaDeformerOptions::with_bounding_axes(scene.light_axes()),
    )
    .expect("expected a CUDA deformer");
    assert!(deformer.fills_gl_buffers(), "expected a deformer that fills the buffers");
    let triangles = scene.triangle_vertices();
    let all_triangles =
        DrawRange { first_triangle: 0, triangle_count: triangles.len() as u32, cull_mode: CullMode::None };
    let geometry =
        RasterGeometry { positions, triangles: triangles.clone(), groups: vec![all_triangles], cut_outs: None };
    let mut rasterizer = CudaRasterizer::new(&context.device, geometry)
        .expect("expected a rasterizer on a buffer that the deformer registered");
    let viewport = clip_space_viewport(300, 200);
    let id_target = context.gl.create_buffer(8 * viewport.pixel_count() as u64);
    for seed in 0..10 {
        deformer.deform(&scenes::random_state(&scene, seed)).expect("expected the step to succeed");
        deformer.fill_gl_buffers().expect("expected filled buffers");
        let got = context.draw_ids(&mut rasterizer, &viewport, &id_target);
        let mut want = VisibilityBuffer::new(viewport);
        want.draw(&deformer.surface().expect("expected a surface").positions, &triangles, all_triangles);
        assert_eq!(count_differences(&got, &want.keys), 0, "step {seed}");
        assert!(got.iter().any(|key| *key != u64::MAX), "expected visible triangles");
    }
    drop((rasterizer, deformer));
    context.gl.renderer.unload(buffers);
}
