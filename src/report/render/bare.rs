//! What drawing a mesh costs a program that does nothing else: one draw into a shadow map's depth, and one into ids and
//! depth of a frame. No culling, no materials, no images, no holes.
//!
//! It shares nothing with the renderer but the OpenGL context, so that it is no part of what it is held against: its own
//! buffers, images and programs, and its own few commands.

use std::time::Instant;

use glow::HasContext as _;
use khronos_egl as egl;
use nalgebra::{Matrix4, Vector3};
use serde::Serialize;

use super::studio::WARM_UP;
use crate::deform::Surface;
use crate::error::{Result, during};
use crate::render::{Shot, shadow_texel};
use crate::report::timing::{FEWEST, Timing};
use crate::scene::Scene;

/// Both passes on one load.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Bare {
    pub load: String,
    pub triangles: usize,
    /// Side of the map that depth is drawn into, and samples a pixel of ids and depth: those of the row beside it.
    pub map: u32,
    pub samples: u32,
    pub depth: Timing,
    pub visibility: Timing,
    /// The row of the renderer that it is held against: its name, its frame, and what that takes beyond both passes,
    /// microseconds.
    pub variant: String,
    pub frame_us: f64,
    pub beyond_us: f64,
}

/// Microseconds beyond both passes that a frame of three million triangles may take on an H200.
pub(super) const BEYOND_US: f64 = 600.0;

const VERTEX: &str = "#version 430 core
layout(location = 0) in vec3 position;
layout(location = 0) uniform mat4 clip_from_world;
void main() { gl_Position = clip_from_world * vec4(position, 1.0); }
";
const FRAGMENT: &str = "#version 430 core
layout(location = 0) out uint id;
void main() { id = uint(gl_PrimitiveID) + 1u; }
";

/// What is drawn: a deformed scene, and from where.
pub(super) struct Sitter<'a> {
    pub(super) scene: &'a Scene,
    pub(super) surface: &'a Surface,
    pub(super) shot: &'a Shot,
    /// Whether the device is the CPU, where timer queries mean nothing.
    pub(super) software: bool,
}

/// Times both passes in the OpenGL context that is current on this thread.
///
/// # Errors
/// `Fault` without a current context, or when OpenGL refuses something.
pub(super) fn time(sitter: &Sitter<'_>, [map, samples]: [u32; 2], replays: usize) -> Result<[Timing; 2]> {
    let gl = Door::current()?;
    let mesh = Mesh::new(&gl, sitter)?;
    let shot = sitter.shot;
    let clip = shot.camera.clip_from_camera(shot.width, shot.height, &shot.bounds) * shot.camera.camera_from_world();
    let depth = Pass::new(&gl, ([map, map], None), &from_the_sun(sitter, map))?;
    let depth = depth.time(&gl, &mesh, sitter.software, replays)?;
    let visibility = Pass::new(&gl, ([shot.width, shot.height], Some(samples)), &clip)?;
    Ok([depth, visibility.time(&gl, &mesh, sitter.software, replays)?])
}

/// Corners of the scene's triangles as vertices.
fn indices(scene: &Scene) -> Vec<u32> {
    let domains = scene.domains.iter().zip(&scene.layout.slots);
    let of_domain = |(domain, slot): (&crate::domain::Domain, &crate::scene::Slot)| {
        let (mesh, first) = (&scene.shapes[domain.shape].mesh, slot.first_vertex as u32);
        let vertices = &mesh.corners().vertices;
        mesh.triangles().iter().flatten().map(move |corner| first + vertices[*corner as usize]).collect::<Vec<u32>>()
    };
    domains.flat_map(of_domain).collect()
}

/// The sun's view of the deformed bounds, at the scale of the renderer's own map.
fn from_the_sun(sitter: &Sitter<'_>, map: u32) -> Matrix4<f64> {
    let Sitter { scene, shot, .. } = sitter;
    let to_sun = scene.look.to_sun(scene.up);
    let reach = shot.bounds.diagonal().max(1e-9);
    // The renderer's map may have another size than this one: they cover the same.
    let size = scene.look.shadow.map_or(map, |shadow| shadow.size);
    let [x, y] = shadow_texel(scene, shot).unwrap_or([Vector3::x() * reach / f64::from(size); 2]);
    let centre = shot.bounds.centre().coords;
    let mut clip = Matrix4::identity();
    for (row, texel) in [x, y].iter().enumerate() {
        let across = texel * (2.0 / (texel.norm_squared() * f64::from(size)));
        clip.fixed_view_mut::<1, 3>(row, 0).copy_from(&across.transpose());
        clip[(row, 3)] = -across.dot(&centre);
    }
    clip.fixed_view_mut::<1, 3>(2, 0).copy_from(&(-to_sun / reach).transpose());
    clip[(2, 3)] = to_sun.dot(&centre) / reach;
    clip
}

/// The functions of the current context. Objects that it made are its own to delete.
struct Door {
    gl: glow::Context,
}

impl Door {
    fn current() -> Result<Self> {
        let fail = |reason: String| during("bare passes")(reason);
        // SAFETY: libEGL is loaded already by whoever made the context; this counts one more user of it.
        let egl = unsafe { egl::DynamicInstance::<egl::EGL1_4>::load_required_from_filename("libEGL.so.1") };
        let egl = egl.map_err(|error| fail(error.to_string()))?;
        egl.get_current_context().ok_or_else(|| fail("no OpenGL context is current".into()))?;
        let address = |name: &std::ffi::CStr| {
            let found = name.to_str().ok().and_then(|name| egl.get_proc_address(name));
            found.map_or(std::ptr::null(), |found| found as *const std::ffi::c_void)
        };
        // SAFETY: a context is current on this thread, and the addresses are those that its EGL gives.
        Ok(Self { gl: unsafe { glow::Context::from_loader_function_cstr(address) } })
    }

    fn check(&self) -> Result<()> {
        // SAFETY: only asks; the context is current.
        match unsafe { self.gl.get_error() } {
            glow::NO_ERROR => Ok(()),
            error => Err(during("bare passes")(format!("OpenGL error 0x{error:04X}"))),
        }
    }
}

struct Mesh<'a> {
    gl: &'a glow::Context,
    array: glow::VertexArray,
    buffers: [glow::Buffer; 2],
    indices: i32,
}

impl<'a> Mesh<'a> {
    fn new(door: &'a Door, sitter: &Sitter<'_>) -> Result<Self> {
        let (gl, indices) = (&door.gl, indices(sitter.scene));
        let count = i32::try_from(indices.len()).map_err(|_| during("bare passes")("too many triangles"))?;
        // SAFETY: fresh objects; indices stay below the vertices that the surface holds, as the scene's layout says.
        let mesh = unsafe {
            let array = gl.create_vertex_array().map_err(during("bare passes"))?;
            let buffers = [gl.create_buffer(), gl.create_buffer()].map(|buffer| buffer.map_err(during("bare passes")));
            let [positions, index] = buffers;
            let (positions, index) = (positions?, index?);
            gl.bind_vertex_array(Some(array));
            gl.bind_buffer(glow::ARRAY_BUFFER, Some(positions));
            let bytes = bytemuck::cast_slice(&sitter.surface.positions);
            gl.buffer_data_u8_slice(glow::ARRAY_BUFFER, bytes, glow::STATIC_DRAW);
            gl.enable_vertex_attrib_array(0);
            gl.vertex_attrib_pointer_f32(0, 3, glow::FLOAT, false, 0, 0);
            gl.bind_buffer(glow::ELEMENT_ARRAY_BUFFER, Some(index));
            gl.buffer_data_u8_slice(glow::ELEMENT_ARRAY_BUFFER, bytemuck::cast_slice(&indices), glow::STATIC_DRAW);
            gl.bind_vertex_array(None);
            Self { gl, array, buffers: [positions, index], indices: count }
        };
        door.check().map(|()| mesh)
    }
}

impl Drop for Mesh<'_> {
    fn drop(&mut self) {
        // SAFETY: own objects of a context that is still current.
        unsafe {
            self.gl.delete_vertex_array(self.array);
            self.buffers.iter().for_each(|buffer| self.gl.delete_buffer(*buffer));
        }
    }
}

/// An image to draw into and the program that does.
struct Pass<'a> {
    gl: &'a glow::Context,
    framebuffer: glow::Framebuffer,
    textures: Vec<glow::Texture>,
    program: glow::Program,
    size: [i32; 2],
    clip: [f32; 16],
}

impl<'a> Pass<'a> {
    /// Depth alone; ids too, when samples a pixel are given.
    fn new(door: &'a Door, (size, samples): ([u32; 2], Option<u32>), clip: &Matrix4<f64>) -> Result<Self> {
        let gl = &door.gl;
        let size = size.map(|side| side as i32);
        let program = program(gl, samples.is_some())?;
        let depth = (glow::DEPTH_ATTACHMENT, glow::DEPTH_COMPONENT32F);
        let ids = samples.map(|_| (glow::COLOR_ATTACHMENT0, glow::R32UI));
        let mut clip_f32 = [0.0; 16];
        clip_f32.iter_mut().zip(clip.iter()).for_each(|(to, from)| *to = *from as f32);
        // SAFETY: fresh objects of sizes that the renderer has drawn before; completeness is asked for.
        let pass = unsafe {
            let framebuffer = gl.create_framebuffer().map_err(during("bare passes"))?;
            let mut pass = Self { gl, framebuffer, textures: Vec::new(), program, size, clip: clip_f32 };
            gl.bind_framebuffer(glow::FRAMEBUFFER, Some(framebuffer));
            for (place, format) in [depth].into_iter().chain(ids) {
                let texture = gl.create_texture().map_err(during("bare passes"))?;
                pass.textures.push(texture);
                let many = samples.unwrap_or(1) as i32;
                let target = if many > 1 { glow::TEXTURE_2D_MULTISAMPLE } else { glow::TEXTURE_2D };
                gl.bind_texture(target, Some(texture));
                match many > 1 {
                    true => gl.tex_storage_2d_multisample(target, many, format, size[0], size[1], true),
                    false => gl.tex_storage_2d(target, 1, format, size[0], size[1]),
                }
                gl.framebuffer_texture(glow::FRAMEBUFFER, place, Some(texture), 0);
            }
            gl.draw_buffers(&[if samples.is_some() { glow::COLOR_ATTACHMENT0 } else { glow::NONE }]);
            match gl.check_framebuffer_status(glow::FRAMEBUFFER) {
                glow::FRAMEBUFFER_COMPLETE => pass,
                status => return Err(during("bare passes")(format!("incomplete framebuffer, 0x{status:04X}"))),
            }
        };
        door.check().map(|()| pass)
    }

    /// One pass, as short as it can be.
    fn draw(&self, mesh: &Mesh<'_>) {
        let gl = self.gl;
        // SAFETY: own objects and plain state; the renderer sets all of it anew for each of its passes.
        unsafe {
            gl.bind_framebuffer(glow::FRAMEBUFFER, Some(self.framebuffer));
            gl.viewport(0, 0, self.size[0], self.size[1]);
            gl.enable(glow::DEPTH_TEST);
            [glow::CULL_FACE, glow::BLEND, glow::DEPTH_CLAMP, glow::POLYGON_OFFSET_FILL]
                .iter()
                .for_each(|flag| gl.disable(*flag));
            gl.depth_func(glow::LESS);
            gl.depth_mask(true);
            gl.clear_buffer_f32_slice(glow::DEPTH, 0, &[1.0]);
            if self.textures.len() > 1 {
                gl.clear_buffer_u32_slice(glow::COLOR, 0, &[0; 4]);
            }
            gl.use_program(Some(self.program));
            gl.uniform_matrix_4_f32_slice(
                gl.get_uniform_location(self.program, "clip_from_world").as_ref(),
                false,
                &self.clip,
            );
            gl.bind_vertex_array(Some(mesh.array));
            gl.draw_elements(glow::TRIANGLES, mesh.indices, glow::UNSIGNED_INT, 0);
            gl.bind_vertex_array(None);
        }
    }

    fn time(&self, door: &Door, mesh: &Mesh<'_>, software: bool, replays: usize) -> Result<Timing> {
        let begin = Instant::now();
        loop {
            self.finished(mesh);
            if software || begin.elapsed() >= WARM_UP {
                break;
            }
        }
        let mut times = Vec::new();
        for _ in 0..replays.max(FEWEST) {
            times.push(if software { self.finished(mesh) } else { self.queried(mesh)? });
        }
        door.check()?;
        Timing::of(times).ok_or_else(|| during("bare passes")("nothing was timed"))
    }

    /// Microseconds by the wall clock, from an idle device to an idle device.
    fn finished(&self, mesh: &Mesh<'_>) -> f64 {
        // SAFETY: only waits.
        unsafe { self.gl.finish() };
        let begin = Instant::now();
        self.draw(mesh);
        // SAFETY: as above.
        unsafe { self.gl.finish() };
        begin.elapsed().as_secs_f64() * 1e6
    }

    /// Microseconds by the device's own clock.
    fn queried(&self, mesh: &Mesh<'_>) -> Result<f64> {
        // SAFETY: a fresh query around own commands; its result is asked for, which waits, before it is deleted.
        unsafe {
            let query = self.gl.create_query().map_err(during("bare passes"))?;
            self.gl.begin_query(glow::TIME_ELAPSED, query);
            self.draw(mesh);
            self.gl.end_query(glow::TIME_ELAPSED);
            let nanoseconds = self.gl.get_query_parameter_u64(query, glow::QUERY_RESULT);
            self.gl.delete_query(query);
            Ok(nanoseconds as f64 / 1e3)
        }
    }
}

impl Drop for Pass<'_> {
    fn drop(&mut self) {
        // SAFETY: own objects of a context that is still current.
        unsafe {
            self.gl.delete_framebuffer(self.framebuffer);
            self.textures.iter().for_each(|texture| self.gl.delete_texture(*texture));
            self.gl.delete_program(self.program);
        }
    }
}

fn program(gl: &glow::Context, ids: bool) -> Result<glow::Program> {
    let stages = [(glow::VERTEX_SHADER, VERTEX), (glow::FRAGMENT_SHADER, FRAGMENT)];
    // SAFETY: fresh objects; shaders are flagged for deletion once the program holds them.
    unsafe {
        let program = gl.create_program().map_err(during("bare passes"))?;
        for (stage, text) in &stages[..if ids { 2 } else { 1 }] {
            let shader = gl.create_shader(*stage).map_err(during("bare passes"))?;
            gl.shader_source(shader, text);
            gl.compile_shader(shader);
            gl.attach_shader(program, shader);
            gl.delete_shader(shader);
        }
        gl.link_program(program);
        match gl.get_program_link_status(program) {
            true => Ok(program),
            false => Err(during("bare passes")(gl.get_program_info_log(program))),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::render::loads;
    use crate::report::render::studio::{Size, Studio};

    /// Ids of the frame's pixels, row by row from below.
    fn ids(pass: &Pass<'_>, mesh: &Mesh<'_>) -> Vec<u32> {
        pass.draw(mesh);
        let mut ids = vec![0_u32; (pass.size[0] * pass.size[1]) as usize];
        // SAFETY: reads as many words as the list has from the own framebuffer, which has one sample a pixel.
        unsafe {
            let into = glow::PixelPackData::Slice(Some(bytemuck::cast_slice_mut(&mut ids)));
            pass.gl.bind_buffer(glow::PIXEL_PACK_BUFFER, None);
            pass.gl.read_pixels(0, 0, pass.size[0], pass.size[1], glow::RED_INTEGER, glow::UNSIGNED_INT, into);
        }
        ids
    }

    #[test]
    fn the_bare_passes_draw_the_whole_mesh_and_not_when_they_look_elsewhere() {
        let mut studio = Studio::open().expect("OpenGL");
        let stage = loads::Kind::Square.stage().expect("built");
        let (size, mut set) = (Size { width: 48, height: 32 }, studio.set(&stage.scene).expect("loaded"));
        studio.pose(&mut set, &stage.state(0)).expect("posed");
        studio.draw(&set, stage.camera(size), size).expect("drawn");
        let shot = set.shot(stage.camera(size), size);
        let sitter =
            Sitter { scene: &stage.scene, surface: set.surface().expect("there"), shot: &shot, software: true };
        let [depth, visibility] = time(&sitter, [64, 4], 1).expect("timed");
        assert!(depth.median_us > 0.0 && visibility.median_us > 0.0 && depth.replays == FEWEST);
        let door = Door::current().expect("a context");
        let mesh = Mesh::new(&door, &sitter).expect("uploaded");
        let seen = |clip: &Matrix4<f64>| ids(&Pass::new(&door, ([64, 64], Some(1)), clip).expect("made"), &mesh);
        let sun = seen(&from_the_sun(&sitter, 64));
        // Slab and square are two triangles each, and the sun sees all four.
        assert!(
            (1..=4).all(|id| sun.contains(&id)) && sun.iter().all(|id| *id <= 4),
            "ids of all triangles and no others"
        );
        let rim = (0..64).flat_map(|at| [at, 63 * 64 + at, 64 * at, 64 * at + 63]);
        assert!(rim.map(|at| sun[at]).all(|id| id == 0), "nothing lies beyond the map");
        let elsewhere = Matrix4::new_translation(&Vector3::new(5.0, 0.0, 0.0)) * from_the_sun(&sitter, 64);
        assert!(seen(&elsewhere).iter().all(|id| *id == 0));
        studio.strike(set);
    }
}
