//! Converts the messages of `ViewService`.

use modalcast_proto::v1;

use super::{parse_step, wire_frame_output};
use crate::engine::{ExportedSlots, FrameOutput, Pairing, ViewSession, ViewSettings, ViewUpdate};
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::{Camera, Scene};
use modalcast_model::views::{MAX_VIEWS, ViewFormat, ViewOutputs};

/// Width and height of a view whose size is not given.
const DEFAULT_SIDE: u32 = 64;

/// Parses what a call draws. [`crate::engine::Engine::open_views`] checks the ranges.
pub(in crate::service) fn parse_view_settings(scene: &Scene, open: v1::OpenViews) -> Result<ViewSettings> {
    let (width, height) = match (open.width, open.height) {
        (0, 0) => (DEFAULT_SIDE, DEFAULT_SIDE),
        size => size,
    };
    let (outputs, depth_includes_ground) = parse_outputs(&open.outputs)?;
    let format = ViewFormat { width, height, outputs, depth_scale: scene.unit as f32, depth_includes_ground };
    let cameras = if open.cameras.is_empty() { vec![v1::Camera::default()] } else { open.cameras };
    let cameras = parse_view_cameras(scene, &format, cameras)?.into();
    let pairing = match open.camera_worlds.is_empty() {
        true => Pairing::Every,
        false => Pairing::One(open.camera_worlds.into()),
    };
    Ok(ViewSettings { worlds: open.worlds.max(1) as usize, format, cameras, pairing })
}

/// The outputs, and whether depth includes the ground.
fn parse_outputs(numbers: &[i32]) -> Result<(ViewOutputs, bool)> {
    let (mut outputs, mut depth_includes_ground) = (ViewOutputs::default(), false);
    for (index, number) in numbers.iter().enumerate() {
        let is_drawn = match v1::Output::try_from(*number) {
            Ok(v1::Output::Unspecified | v1::Output::Color) => &mut outputs.color,
            Ok(v1::Output::Depth) => &mut outputs.depth,
            Ok(v1::Output::DepthWithGround) => {
                depth_includes_ground = true;
                &mut outputs.depth
            }
            Ok(v1::Output::Domains) => &mut outputs.domains,
            Ok(v1::Output::Normals) => &mut outputs.normals,
            Ok(output @ (v1::Output::Displacement | v1::Output::ModeShape)) => {
                return Err(invalid(format!("outputs[{index}]"), "an output of views", output.as_str_name()));
            }
            Err(_) => return Err(invalid(format!("outputs[{index}]"), "an output of this version", number)),
        };
        if std::mem::replace(is_drawn, true) {
            return Err(invalid(format!("outputs[{index}]"), "each output once, and one kind of depth", number));
        }
    }
    if numbers.is_empty() {
        outputs.color = true;
    }
    Ok((outputs, depth_includes_ground))
}

fn parse_view_cameras(scene: &Scene, format: &ViewFormat, cameras: Vec<v1::Camera>) -> Result<Vec<Camera>> {
    if cameras.len() > MAX_VIEWS {
        return Err(invalid("cameras", format!("at most {MAX_VIEWS} cameras"), cameras.len()));
    }
    let fit_to_scene = Camera::fit_to_scene(scene, format.width, format.height);
    let parse = |(index, camera)| {
        super::camera::parse_camera(scene, fit_to_scene, camera)
            .map_err(|error| error.in_message(&format!("cameras[{index}]")))
    };
    cameras.into_iter().enumerate().map(parse).collect()
}

/// Parses a step of a session.
pub(in crate::service) fn parse_view_update(
    session: &ViewSession,
    step: v1::Step,
    cameras: Vec<v1::Camera>,
    drawn_worlds: u32,
) -> Result<ViewUpdate> {
    Ok(ViewUpdate {
        step: parse_step(step)?,
        cameras: parse_view_cameras(session.scene(), &session.settings().format, cameras)?,
        drawn_worlds: drawn_worlds as usize,
    })
}

/// Confirms what a session draws.
pub(in crate::service) fn wire_views_opened(session: &ViewSession) -> v1::ViewsOpened {
    let (settings, scene) = (session.settings(), session.scene());
    let ViewFormat { width, height, outputs, depth_includes_ground, .. } = settings.format;
    let depth = if depth_includes_ground { FrameOutput::DepthWithGround } else { FrameOutput::Depth };
    let drawn = [
        (outputs.color, FrameOutput::Color),
        (outputs.depth, depth),
        (outputs.domains, FrameOutput::Domains),
        (outputs.normals, FrameOutput::Normals),
    ];
    let drawn = drawn.into_iter().filter(|(is_drawn, _)| *is_drawn);
    v1::ViewsOpened {
        worlds: settings.worlds as u32,
        width,
        height,
        outputs: drawn.map(|(_, output)| wire_frame_output(output).into()).collect(),
        views: settings.views() as u32,
        coordinates: scene.layout.coordinates as u32,
        transforms: scene.transform_roots.count() as u32,
        device_slots: None,
    }
}

/// Describes exported device memory.
pub(in crate::service) fn wire_device_slots(exported: &ExportedSlots) -> v1::DeviceSlots {
    v1::DeviceSlots {
        device: exported.device.to_vec().into(),
        bytes: exported.files.iter().map(|(_, bytes)| *bytes).collect(),
        offsets: exported.layout.drawn_offsets().collect(),
    }
}
