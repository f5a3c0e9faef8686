//! Exact order-independent transparency: a list of all blended fragments of each pixel, in bounded memory.
//!
//! One pass counts the fragments, a prefix sum allocates a list for each pixel, and another pass fills the lists in any
//! order. The lists are sorted by depth and id before they are blended, so the picture does not depend on the order of
//! the fragments. The memory budget is a number of fragments. When a frame has more, every pixel keeps at most the same
//! number of its nearest fragments: the largest number for which all lists fit, up to 256. Dropped fragments are
//! counted.

use std::rc::Rc;

use bytemuck::{Pod, Zeroable};

use super::Ran;
use super::cull::command;
use super::geometry::Kind;
use super::gl::{self, Buffer, Clear, Fixed, Framebuffer, Gl, Limits, Program, Texture, TextureKind};
use super::passes::{NO_TILES, TILES, begins, bind_shadow, draw_group, listed};
use super::region::{Region, Touched};
use super::scene_buffers::SceneBuffers;
use super::shaders::lists::{BINS, TALLY};
use super::shaders::{self, Options, TILE};
use super::target::{Blended, Form};
use modalcast_model::error::Result;
use modalcast_model::scene::{Look, MAX_FRAGMENTS};

const RECORDS: u32 = 2;
const LEDGER: u32 = 3;
const COUNTS: u32 = 1;
const ENDS: u32 = 2;
const LAYERS: u32 = 3;
/// Bytes of a fragment: depth, then id and coverage.
const RECORD_BYTES: u64 = 8;
/// Default budget in fragments per pixel, and its minimum per frame.
const USUAL: u64 = 8;
const FEWEST: u64 = 1 << 20;
/// Phases of the gather program: count, fill, and add ids to the kept depths.
const COUNT: i32 = 0;
const FILL: i32 = 1;
const JOIN: i32 = 2;

/// Fragment statistics of a frame.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct Lists {
    /// Blended fragments that are not wholly transparent and not hidden by something opaque.
    pub fragments: u64,
    /// Fragments within the budget. The others, the farthest of their pixels, are missing in the picture.
    pub kept: u64,
    /// Largest number of fragments in a pixel.
    pub deepest: u32,
    /// Maximum number of fragments per pixel, when the budget was exceeded.
    pub bound: Option<u32>,
}

impl Lists {
    /// Fragments that are missing in the picture.
    pub const fn dropped(&self) -> u64 {
        self.fragments - self.kept
    }
}

/// Counters and indirect draws of a frame. Twin of `Ledger` in `shaders/shared/lists.glsl`, up to its bins.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct Ledger {
    total: [u32; 2],
    deepest: u32,
    most: u32,
    used: u32,
    budget: u32,
    /// Indirect draws: index count, instances, first index, base vertex, base instance.
    commands: [[u32; 5]; 2],
}

pub(super) const HEAD: usize = size_of::<Ledger>();
const COMMANDS: usize = 24;
const LEDGER_BYTES: usize = HEAD + 4 * BINS;
const _: () = assert!(HEAD == 64, "Ledger differs from shaders/shared/lists.glsl");

/// Programs of exact transparency.
#[derive(Debug, Clone)]
pub(super) struct ListPrograms {
    gather: Rc<Program>,
    tally: Rc<Program>,
    place: Rc<Program>,
    resolve: Rc<Program>,
}

/// Images and buffers of exact transparency for frames of one form.
#[derive(Debug)]
pub(super) struct ListTarget {
    /// Blended fragments of each pixel.
    pub(super) counts: Texture,
    ends: Texture,
    /// One array layer per sample.
    pub(super) layers: Texture,
    /// Framebuffer that clears the counts.
    counted: Framebuffer,
    touched: Touched,
    /// Framebuffer with depth only, for the depth test.
    behind: Framebuffer,
    records: Buffer,
    pub(super) ledger: Buffer,
    tiles: Buffer,
}

/// Number of fragment records that a frame may use.
///
/// # Errors
/// `Invalid` when the look asks for more records than fit into one buffer of the device.
pub(super) fn budget(limits: &Limits, look: &Look, [width, height]: [u32; 2]) -> Result<u32> {
    let most = u64::from(MAX_FRAGMENTS).min(limits.max_storage / RECORD_BYTES);
    if let Some(fragments) = look.fragments {
        let fits = u64::from(fragments) <= most;
        return if fits { Ok(fragments) } else { Err(gl::too_large("look.fragments", most, fragments.into())) };
    }
    Ok((USUAL * u64::from(width) * u64::from(height)).max(FEWEST).min(most) as u32)
}

impl ListPrograms {
    pub(super) fn compile(options: &Options, samples: u32, compile: &mut super::programs::Compile<'_>) -> Result<Self> {
        Ok(Self {
            gather: compile(options.gather(samples))?,
            tally: compile(shaders::lists::tally())?,
            place: compile(shaders::lists::place())?,
            resolve: compile(options.resolve_lists(samples))?,
        })
    }
}

impl ListTarget {
    pub(super) fn new(gl: &Rc<Gl>, form: Form, budget: u32, depth: &Texture) -> Result<Self> {
        let Form { width, height, samples, .. } = form;
        let image = |target: u32, format: u32, depth: u32| {
            let texture = gl.texture(TextureKind { target, format, width, height, depth, levels: 1 })?;
            texture.sampling(&[(gl::TEXTURE_MIN_FILTER, gl::NEAREST), (gl::TEXTURE_MAG_FILTER, gl::NEAREST)], 1.0);
            Ok(texture)
        };
        let counts = image(gl::TEXTURE_2D, gl::R32UI, 1)?;
        let tiles = u64::from(width.div_ceil(TILE)) * u64::from(height.div_ceil(TILE));
        Ok(Self {
            counted: gl.colour_framebuffer(&counts)?,
            touched: Touched::default(),
            behind: gl.framebuffer(None, depth)?,
            counts,
            ends: image(gl::TEXTURE_2D, gl::R32UI, 1)?,
            layers: image(gl::TEXTURE_2D_ARRAY, gl::RGBA16F, samples)?,
            records: gl.buffer(RECORD_BYTES * u64::from(budget), gl::STREAM_COPY, None)?,
            ledger: gl.buffer(LEDGER_BYTES as u64, gl::STREAM_COPY, None)?,
            tiles: gl.buffer(16 + 4 * tiles, gl::STREAM_COPY, None)?,
        })
    }

    fn bind(&self) {
        self.counts.bind_image_both_ways(COUNTS);
        self.ends.bind_image_both_ways(ENDS);
        self.records.bind_storage(RECORDS);
        self.ledger.bind_storage(LEDGER);
        self.tiles.bind_storage(TILES);
    }

    /// Resets the ledger: nothing is counted, and the number of records per pixel is unlimited.
    fn empty(&self, gl: &Gl, buffers: &SceneBuffers) {
        let mut commands = [[0; 5]; 2];
        let blended = buffers.groups.iter().filter(|group| group.kind == Kind::Blend);
        for (command, group) in commands.iter_mut().zip(blended) {
            *command = [3 * group.triangles as u32, 0, 3 * group.first_triangle as u32, 0, 0];
        }
        let budget = (self.records.bytes / RECORD_BYTES) as u32;
        let head = Ledger { total: [0; 2], deepest: 0, most: u32::MAX, used: 0, budget, commands };
        let mut bytes = vec![0; LEDGER_BYTES];
        bytes[..HEAD].copy_from_slice(bytemuck::bytes_of(&head));
        self.ledger.write(&bytes);
        let blended = buffers.groups.iter().enumerate().filter(|(_, group)| group.kind == Kind::Blend);
        for (index, (place, _)) in blended.enumerate() {
            // A culled scene draws only as many indices as are listed.
            if let Some((_, listed)) = buffers.listed(Kind::Blend) {
                let to = COMMANDS + size_of::<[u32; 5]>() * index;
                gl.copy_part((listed, command(place)), (&self.ledger, to), size_of::<u32>());
            }
        }
        self.tiles.write(bytemuck::cast_slice(&NO_TILES));
    }
}

/// Fragment statistics of a frame, from the head of its ledger.
pub(super) fn told(head: &[u8]) -> Lists {
    let mut ledger = Ledger::zeroed();
    // A byte copy, because `head` may be unaligned; it has the length of the ledger.
    bytemuck::bytes_of_mut(&mut ledger).iter_mut().zip(head).for_each(|(to, from)| *to = *from);
    let [low, high] = ledger.total.map(u64::from);
    let bound = (ledger.most != u32::MAX).then_some(ledger.most);
    Lists { fragments: high << 32 | low, kept: ledger.used.into(), deepest: ledger.deepest, bound }
}

/// Draws the layers of the blended triangles in front of the opaque ones, against whose depth they are tested.
pub(super) fn draw(
    gl: &Gl,
    buffers: &SceneBuffers,
    (target, part): (&ListTarget, Region),
    programs: &ListPrograms,
    ran: &mut Ran,
) -> Result<()> {
    target.empty(gl, buffers);
    let [width, height] = part.frame();
    gl.begin(&target.counted, part, Clear::Words(&target.touched));
    target.bind();
    gather(gl, buffers, (target, part), (programs, COUNT), ran);
    gl.check("count")?;
    programs.tally.bind(None);
    gl.dispatch(width.div_ceil(TALLY), height.div_ceil(TALLY));
    programs.place.bind(None);
    gl.dispatch(width.div_ceil(TILE), height.div_ceil(TILE));
    gl.check("scan")?;
    gather(gl, buffers, (target, part), (programs, FILL), ran);
    gather(gl, buffers, (target, part), (programs, JOIN), ran);
    gl.check("fill")?;
    bind_shadow(buffers);
    target.layers.bind_image(LAYERS);
    programs.resolve.bind(None);
    gl.dispatch_listed(&target.tiles);
    ran.passes.extend(PASSES);
    gl.check("resolve")
}

/// The passes of exact transparency.
pub(super) const PASSES: [&str; 4] = ["count", "scan", "fill", "resolve"];

/// Draws all blended triangles for one phase. In the last phase the ledger gives the number of instances: none when all
/// fragments fit.
fn gather(
    gl: &Gl,
    buffers: &SceneBuffers,
    (target, part): (&ListTarget, Region),
    (programs, turn): (&ListPrograms, i32),
    ran: &mut Ran,
) {
    let (all, drawn) = (buffers.array(Kind::Blend), listed(buffers));
    let array = buffers.listed(Kind::Blend).map(|(array, _)| array).or(all);
    let Some(array) = array else { return };
    gl.begin(&target.behind, part, Clear::Nothing);
    let groups = buffers.groups.iter().enumerate().filter(|(_, group)| group.kind == Kind::Blend);
    for (index, (place, group)) in groups.enumerate() {
        gl.set(Fixed { cull: !group.double_sided, ..Fixed::default() });
        programs.gather.bind(Some(begins(group, drawn)));
        programs.gather.turn(turn);
        if turn == JOIN {
            gl.draw_told(array, &target.ledger, COMMANDS + size_of::<[u32; 5]>() * index);
        } else {
            draw_group(gl, buffers, place, drawn);
        }
        ran.draws += 1;
    }
    gl.wait_for_stores();
}

/// How a frame of this look draws blended triangles.
pub(super) fn wanted(gl: &Gl, scene: &modalcast_model::scene::Scene, size: [u32; 2]) -> Result<Blended> {
    match scene.look.transparency {
        _ if !scene.needs.blend => Ok(Blended::None),
        modalcast_model::scene::Transparency::TwoPass => Ok(Blended::Drawn),
        modalcast_model::scene::Transparency::Exact => budget(&gl.limits, &scene.look, size).map(Blended::Listed),
    }
}

#[cfg(test)]
mod tests {
    use super::super::geometry::tests::squares;
    use super::super::{Prefer, Renderer, Shot};
    use super::*;
    use modalcast_model::deform::Surface;
    use modalcast_model::domain::{AlphaMode, Material};
    use modalcast_model::scene::{Bounds, Camera, Scene, Transparency};

    #[test]
    fn the_budget_is_eight_a_pixel_or_what_the_look_says_as_far_as_one_buffer_reaches() {
        let limits = |max_storage: u64| Limits { max_storage, ..Limits::default() };
        let of = |fragments: Option<u32>, max_storage: u64, size: [u32; 2]| {
            budget(&limits(max_storage), &Look { fragments, ..Look::default() }, size)
        };
        assert_eq!(of(None, 1 << 31, [640, 480]).expect("fits"), 8 * 640 * 480);
        assert_eq!(of(None, 1 << 31, [1, 1]).expect("fits"), 1 << 20);
        assert_eq!(of(None, 1 << 27, [8192, 8192]).expect("less"), 1 << 24, "as many as fit");
        assert_eq!(of(Some(100), 1 << 27, [8192, 8192]).expect("fits"), 100);
        let refusal = of(Some(1 << 25), 1 << 27, [64, 64]).expect_err("refused").to_string();
        assert_eq!(refusal, "look.fragments: expected at most 16777216 on this device, given 33554432");
    }

    /// Draws a glass square in front of an opaque square and another behind it, 64 pixels wide; returns the pixels and
    /// the renderer.
    fn drawn(transparency: Transparency, alpha_mode: AlphaMode, post_depth: bool) -> (Vec<u8>, Renderer) {
        let glass = Material { alpha: 0.5, alpha_mode, double_sided: true, ..Material::default() };
        let mut parts =
            squares(vec![Material { diffuse: [0.9, 0.2, 0.1], ..Material::default() }, glass.clone(), glass]);
        // No shadow: light that varies within a pixel would reveal where in the pixel a fragment is shaded.
        (parts.look.transparency, parts.look.shadow) = (transparency, None);
        // Slightly rotated, so that edges cross pixels.
        let corner = |z: f32, angle: f32, [x, y]: [f32; 2]| {
            let (sine, cosine) = angle.sin_cos();
            [cosine * x - sine * y, sine * x + cosine * y, z]
        };
        let square = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
        let positions: Vec<[f32; 3]> = [(0.0, 0.3), (0.3, 0.5), (-0.3, 0.7)]
            .into_iter()
            .flat_map(|(z, angle)| square.map(|at| corner(z, angle, at)))
            .collect();
        let mut bounds = Bounds::EMPTY;
        positions.iter().for_each(|position| bounds.include(position.map(f64::from)));
        let surface = Surface {
            positions: positions.as_flattened().to_vec(),
            normals: [0.0, 0.0, 1.0].repeat(positions.len()),
            ..Surface::default()
        };
        let scene = Scene::new(parts).expect("good");
        let mut renderer = Renderer::open(Prefer::Any).expect("EGL");
        let gl = Rc::get_mut(&mut renderer.gl).expect("not shared yet");
        gl.limits.post_depth &= post_depth;
        let buffers = renderer.load(&scene).expect("loads");
        renderer.upload(&buffers, &surface).expect("uploads");
        let camera = Camera::framing(&scene, 64, 64);
        let image =
            renderer.draw(&buffers, &Shot { camera, width: 64, height: 64, bounds, light: None }).expect("draws");
        (image.rgba, renderer)
    }

    #[test]
    fn a_fragment_a_pixel_with_its_samples_and_a_fragment_a_sample_give_the_same_picture() {
        let (known, renderer) = drawn(Transparency::Exact, AlphaMode::Blend, true);
        let (apart, other) = drawn(Transparency::Exact, AlphaMode::Blend, false);
        let worst = known.iter().zip(&apart).map(|(a, b)| a.abs_diff(*b)).max();
        assert!(worst <= Some(2), "{worst:?} levels");
        let [few, many] = [&renderer, &other].map(|renderer| renderer.ran().lists.expect("exact").fragments);
        assert!(!renderer.gl.limits.post_depth || many > 3 * few, "control: {few} and {many} fragments");
    }

    #[test]
    fn only_the_method_that_the_look_names_is_compiled_and_neither_without_blended_triangles() {
        let compiled = |transparency, alpha_mode| {
            let (_, renderer) = drawn(transparency, alpha_mode, true);
            let any = |name: &str| renderer.programs.keys().any(|source| source.label.starts_with(name));
            (["gather", "tally", "place", "resolve"].map(any), any("blended"))
        };
        assert_eq!(compiled(Transparency::Exact, AlphaMode::Opaque), ([false; 4], false));
        assert_eq!(compiled(Transparency::TwoPass, AlphaMode::Opaque), ([false; 4], false));
        assert_eq!(compiled(Transparency::Exact, AlphaMode::Blend), ([true; 4], false));
        assert_eq!(compiled(Transparency::TwoPass, AlphaMode::Blend), ([false; 4], true));
    }
}
