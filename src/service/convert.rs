//! Conversions between wire messages and engine types. `wire_` functions create messages, `parse_` functions read them.
//! Numbers from the wire are untrusted until a constructor of `modalcast_model::scene` has validated them.

use std::time::Duration;

use bytes::Bytes;
use modalcast_proto::v1;

use super::status::to_rejection;
use crate::admission::Account;
use crate::config::{Config, MAX_STALL_BUDGET};
use crate::engine::{
    self, ContentHash, Delivery, Engine, FailedScene, FrameFormat, InitialState, LeaseRequest, LeaseToken, OutputSpec,
    Overflow, PictureSpec, SceneAccess, SceneHandle, SceneRight, StepId, StepSelector, StreamDelivery, UploadedShape,
    WriterSession, parse_hash,
};
use crate::telemetry::StageTimes;
use modalcast_model::domain::{CreaseAngle, Material, Transform};
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::{
    Camera, CameraSource, FrameSize, PixelRect, RawStepUpdate, Scene, ToneMapping, TransformFormat, UpAxis,
};

mod camera;
mod frame_info;
mod output;
mod vertices;
mod views;

pub(super) use frame_info::wire_frame_info;
pub(super) use output::{FrameUse, wire_format, wire_frame_output};
pub(super) use vertices::{parse_vertex_selection, wire_sections};
pub(super) use views::{parse_view_settings, parse_view_update, wire_device_slots, wire_views_opened};

/// Limit in bytes on the remarks in one scene description.
const MAX_REMARK_BYTES: usize = 64 << 10;

/// The public description of an open scene.
pub(super) fn wire_scene_info(scene_handle: &SceneHandle) -> v1::SceneInfo {
    let scene = &scene_handle.scene;
    let (remarks, lighting) = (list_remarks(scene), Some(wire_lighting(scene)));
    v1::SceneInfo { remarks, lighting, ..wire_scene_summary(scene_handle) }
}

fn wire_lighting(scene: &Scene) -> v1::Lighting {
    let look = &scene.look;
    let tone_mapping = match look.tone {
        ToneMapping::None => v1::ToneMapping::None,
        ToneMapping::Reinhard => v1::ToneMapping::Reinhard,
        ToneMapping::Aces => v1::ToneMapping::Aces,
    };
    let studio = look.studio_light(scene.up);
    v1::Lighting {
        to_sun: look.to_sun(scene.up).iter().map(|component| *component as f32).collect(),
        sunlight: look.sunlight.to_vec(),
        skylight: look.skylight.to_vec(),
        zenith: look.zenith.to_vec(),
        horizon: look.horizon.to_vec(),
        ground: look.ground_color(scene.up).map(Vec::from).unwrap_or_default(),
        shadows: look.shadow.is_some(),
        exposure: look.exposure,
        tone_mapping: tone_mapping.into(),
        ambient_cube: studio.map(|studio| studio.ambient_cube.as_flattened().to_vec()).unwrap_or_default(),
        fill: studio.map(|studio| studio.fill.to_vec()).unwrap_or_default(),
        ambient_occlusion_radius: look.ambient_occlusion.map(|occlusion| occlusion.radius),
    }
}

/// The public description of an open scene without its remarks and lighting.
pub(super) fn wire_scene_summary(scene_handle: &SceneHandle) -> v1::SceneInfo {
    let scene = &scene_handle.scene;
    let layout = &scene.layout;
    let bounds = scene.rest_bounds;
    let SceneAccess { owner, shared_with } = scene_handle.access();
    v1::SceneInfo {
        scene: scene_handle.name.clone(),
        source: scene_handle.provenance.label(),
        domains: scene.domains.len() as u32,
        vertices: layout.vertices as u64,
        corners: layout.corners as u64,
        triangles: layout.triangles as u64,
        coordinates: layout.coordinates as u64,
        up: ["x", "y", "z"][scene.up.index()].into(),
        unit: scene.unit,
        origin: scene.origin.to_vec(),
        bounds: [bounds.min, bounds.max].concat(),
        affine: scene.features.shear,
        last_step: scene_handle.last_step().map(wire_step_id),
        durable_step: scene_handle.durable_step().map(wire_step_id),
        remarks: Vec::new(),
        lighting: None,
        owner,
        shared_with: shared_with.into_iter().collect(),
        writer: scene_handle.writer().map(|account| account.principal_name().to_owned()).unwrap_or_default(),
        streams: scene_handle.subscription_count() as u32,
    }
}

/// A scene that could not be opened, and why.
pub(super) fn wire_failed_scene(failed: FailedScene) -> v1::FailedScene {
    let FailedScene { name, source, error, access: _ } = failed;
    v1::FailedScene { scene: name, source, error: Some(to_rejection(None, &error)) }
}

/// Number of bytes that remain of a limit on the encoded size of a list of strings.
pub(super) struct ByteBudget(usize);

impl ByteBudget {
    /// Upper bound on the bytes that protobuf adds to a string: tag and length.
    const STRING_OVERHEAD_BYTES: usize = 8;

    pub(super) const fn new(bytes: usize) -> Self {
        Self(bytes)
    }

    /// Subtracts the size of a string. Returns false when the budget is used up.
    pub(super) fn take_string(&mut self, text: &str) -> bool {
        self.0 = self.0.saturating_sub(text.len() + Self::STRING_OVERHEAD_BYTES);
        self.0 > 0
    }
}

/// The remarks of the loader on a scene, up to [`MAX_REMARK_BYTES`].
fn list_remarks(scene: &Scene) -> Vec<String> {
    let mut budget = ByteBudget::new(MAX_REMARK_BYTES);
    let mut remarks: Vec<String> =
        scene.remarks.iter().take_while(|remark| budget.take_string(remark)).cloned().collect();
    if remarks.len() < scene.remarks.len() {
        remarks.push(format!("and {} more", scene.remarks.len() - remarks.len()));
    }
    remarks
}

pub(super) const fn wire_step_id(step: StepId) -> v1::StepId {
    v1::StepId { run: step.run, number: step.number, time: step.time }
}

pub(super) fn wire_stages(times: &StageTimes) -> Vec<v1::StageTime> {
    times.iter().map(|(stage, ms)| v1::StageTime { stage: stage.name().into(), milliseconds: *ms as f32 }).collect()
}

pub(super) fn parse_step(step: v1::Step) -> Result<RawStepUpdate> {
    let transform_format = match v1::TransformFormat::try_from(step.transform_format) {
        Ok(v1::TransformFormat::Unspecified | v1::TransformFormat::AffineF32) => TransformFormat::Affine,
        Ok(v1::TransformFormat::QuaternionXyzwF32) => TransformFormat::QuaternionXyzwF32,
        Ok(v1::TransformFormat::QuaternionXyzwF64) => TransformFormat::QuaternionXyzwF64,
        Err(_) => return Err(invalid("step.transform_format", "a format of this version", step.transform_format)),
    };
    Ok(RawStepUpdate {
        number: step.number,
        time: step.time,
        q_domains: step.q_domains,
        q: step.q,
        transform_domains: step.transform_domains,
        transforms: step.transforms,
        transform_format,
    })
}

/// Parses the delivery of a subscription, which must be named, and the limit on its rate.
pub(super) fn parse_stream_delivery(delivery: i32, max_hz: f64) -> Result<StreamDelivery> {
    StreamDelivery::new(parse_delivery("delivery", delivery)?, max_hz)
}

/// The right to a scene that a stream with this delivery needs: a lossless stream can slow the writer.
pub(super) const fn right_to_receive(delivery: StreamDelivery) -> SceneRight {
    match delivery.delivery() {
        Delivery::Lossless => SceneRight::Control,
        Delivery::Latest => SceneRight::Use,
    }
}

/// Parses the delivery of a stream, which must be named.
pub(super) fn parse_delivery(field: &str, number: i32) -> Result<Delivery> {
    match v1::Delivery::try_from(number) {
        Ok(v1::Delivery::Lossless) => Ok(Delivery::Lossless),
        Ok(v1::Delivery::Latest) => Ok(Delivery::Latest),
        Ok(v1::Delivery::Unspecified) => {
            let expected = "DELIVERY_LOSSLESS (every step) or DELIVERY_LATEST (the newest step)";
            Err(invalid(field, expected, "DELIVERY_UNSPECIFIED"))
        }
        Err(_) => Err(invalid(field, "a delivery of this version", number)),
    }
}

/// Parses the request of a writer for the lease of a scene. A window of 0 means `default_window`.
pub(super) fn parse_lease_request(open: &v1::OpenDrive, account: &Account, config: &Config) -> Result<LeaseRequest> {
    let overflow = match v1::Overflow::try_from(open.overflow) {
        Ok(v1::Overflow::Unspecified | v1::Overflow::Block) => Overflow::Block,
        Ok(v1::Overflow::Reject) => Overflow::Reject,
        Err(_) => return Err(invalid("open.overflow", "an overflow of this version", open.overflow)),
    };
    let initial_state = match v1::InitialState::try_from(open.initial_state) {
        Ok(v1::InitialState::Unspecified) => None,
        Ok(v1::InitialState::Keep) => Some(InitialState::Keep),
        Ok(v1::InitialState::Reset) => Some(InitialState::Reset),
        Err(_) => return Err(invalid("open.initial_state", "an initial state of this version", open.initial_state)),
    };
    let is_token_given = !open.lease_token.is_empty();
    let token = is_token_given.then(|| LeaseToken::parse("open.lease_token", &open.lease_token)).transpose()?;
    Ok(LeaseRequest {
        account: account.clone(),
        delivery: parse_delivery("open.delivery", open.delivery)?,
        overflow,
        window: if open.window == 0 { config.window } else { open.window },
        stall_budget: parse_stall_budget(open.stall_budget_ms, config.stall_budget)?,
        token,
        takes_over: open.take_over,
        initial_state,
    })
}

/// The stall budget that a writer asks for; `default` if it names none.
fn parse_stall_budget(ms: u32, default: Duration) -> Result<Duration> {
    let stall_budget = if ms == 0 { default } else { Duration::from_millis(ms.into()) };
    match stall_budget <= MAX_STALL_BUDGET {
        true => Ok(stall_budget),
        false => Err(invalid("open.stall_budget_ms", format!("at most {}", MAX_STALL_BUDGET.as_millis()), ms)),
    }
}

pub(super) const fn wire_delivery(delivery: Delivery) -> v1::Delivery {
    match delivery {
        Delivery::Lossless => v1::Delivery::Lossless,
        Delivery::Latest => v1::Delivery::Latest,
    }
}

/// The reply to a writer that has acquired the lease: the settings in effect.
pub(super) fn wire_opened(writer: &WriterSession, request: &LeaseRequest, scene_handle: &SceneHandle) -> v1::Opened {
    let overflow = match request.overflow {
        Overflow::Block => v1::Overflow::Block,
        Overflow::Reject => v1::Overflow::Reject,
    };
    let initial_state = match writer.initial_state {
        InitialState::Keep => v1::InitialState::Keep,
        InitialState::Reset => v1::InitialState::Reset,
    };
    v1::Opened {
        run: writer.run,
        delivery: wire_delivery(request.delivery).into(),
        overflow: overflow.into(),
        window: writer.window,
        stall_budget_ms: request.stall_budget.as_millis() as u32,
        lease_token: writer.token.as_bytes().to_vec().into(),
        initial_state: initial_state.into(),
        scene: Some(wire_scene_info(scene_handle)),
    }
}

/// A requested picture and the format of its frames.
#[derive(Debug, Clone, Copy)]
pub(super) struct RequestedPicture {
    pub spec: PictureSpec,
    pub format: FrameFormat,
}

/// Maximum number of pictures of a request.
const MAX_PICTURES: usize = 16;

/// Validates the pictures of a request. An empty list is one default picture.
pub(super) fn parse_pictures(
    engine: &Engine,
    scene: &Scene,
    pictures: Vec<v1::Picture>,
    frame_use: FrameUse,
) -> Result<Vec<RequestedPicture>> {
    if pictures.len() > MAX_PICTURES {
        return Err(invalid("pictures", format!("at most {MAX_PICTURES} pictures"), pictures.len()));
    }
    let pictures = if pictures.is_empty() { vec![v1::Picture::default()] } else { pictures };
    let parse = |(index, picture)| {
        parse_picture(engine, scene, picture, frame_use)
            .map_err(|error| error.in_message(&format!("pictures[{index}]")))
    };
    let pictures = pictures.into_iter().enumerate().map(parse).collect::<Result<Vec<_>>>()?;
    let total_pixels = count_pixels(&pictures);
    // As many as the largest single picture has, so that several pictures need no more memory than one may need.
    let max_pixels = u64::from(engine.frame_side()).pow(2);
    if total_pixels > max_pixels {
        return Err(invalid("pictures", format!("at most {max_pixels} pixels in total"), total_pixels));
    }
    Ok(pictures)
}

/// Number of pixels of all pictures together.
pub(super) fn count_pixels(pictures: &[RequestedPicture]) -> u64 {
    let of_one = |picture: &RequestedPicture| u64::from(picture.spec.size.width) * u64::from(picture.spec.size.height);
    pictures.iter().map(of_one).sum()
}

/// Validates a picture. The field of an error is relative to the picture.
fn parse_picture(
    engine: &Engine,
    scene: &Scene,
    picture: v1::Picture,
    frame_use: FrameUse,
) -> Result<RequestedPicture> {
    let (output, format) = output::parse_output(scene, &picture)?;
    let (width, height) = match (picture.width, picture.height) {
        (0, 0) => (1280, 720),
        size => size,
    };
    let max_side = engine.frame_side();
    if !(1..=max_side).contains(&width) || !(1..=max_side).contains(&height) {
        let expected = format!("1 to {max_side} pixels per side, or 0 x 0 for 1280 x 720");
        return Err(invalid("width", expected, format!("{width} x {height}")));
    }
    let size = FrameSize::new(width, height);
    let style = output::parse_style(scene, output, &picture, frame_use)?;
    let camera = parse_picture_camera(scene, size, picture.camera)?;
    Ok(RequestedPicture { spec: PictureSpec { camera, size, output, style }, format })
}

/// Validates the camera of a picture. An unset camera frames the scene.
fn parse_picture_camera(scene: &Scene, size: FrameSize, camera: Option<v1::Camera>) -> Result<CameraSource> {
    let Some(camera) = camera else { return Ok(CameraSource::framing(scene, size)) };
    let fit_to_scene = Camera::fit_to_scene(scene, size.width, size.height);
    camera::parse_camera(scene, fit_to_scene, camera).map(CameraSource::Fixed)
}

/// Validates new cameras of a stream's pictures. Returns the index of each picture with its camera.
pub(super) fn parse_moved_cameras(
    scene: &Scene,
    pictures: &[PictureSpec],
    cameras: Vec<v1::PictureCamera>,
) -> Result<Vec<(usize, CameraSource)>> {
    if cameras.is_empty() {
        return Err(invalid("cameras", "at least one camera", "none"));
    }
    let mut moved_cameras = Vec::<(usize, CameraSource)>::with_capacity(cameras.len().min(pictures.len()));
    for (position, v1::PictureCamera { picture: index, camera }) in cameras.into_iter().enumerate() {
        let picture = pictures.get(index as usize);
        let is_repeated = moved_cameras.iter().any(|(moved_index, _)| *moved_index == index as usize);
        let Some(picture) = picture.filter(|_| !is_repeated) else {
            let expected = format!("an index below {}, each once", pictures.len());
            return Err(invalid(format!("cameras[{position}].picture"), expected, index));
        };
        let camera = parse_picture_camera(scene, picture.size, camera)
            .map_err(|error| error.in_message(&format!("cameras[{position}]")))?;
        moved_cameras.push((index as usize, camera));
    }
    Ok(moved_cameras)
}

/// Validates a pick request. Returns an [`OutputSpec::Pick`].
pub(super) fn parse_pick(engine: &Engine, scene: &Scene, request: &v1::PickRequest) -> Result<OutputSpec> {
    // A pick ignores the output and the format of its picture.
    let picture = request.picture.clone().unwrap_or_default();
    let size_and_camera =
        v1::Picture { width: picture.width, height: picture.height, camera: picture.camera, ..v1::Picture::default() };
    let picture =
        parse_picture(engine, scene, size_and_camera, FrameUse::Still).map_err(|error| error.in_message("picture"))?;
    let PictureSpec { camera, size: picture, .. } = picture.spec;
    let size = match (request.width, request.height) {
        (0, 0) => [1, 1],
        (width, height) => [width, height],
    };
    let rectangle = PixelRect::within(picture.to_array(), [request.x, request.y], size)?;
    Ok(OutputSpec::Pick { camera, picture, rectangle })
}

/// A picture with all defaults resolved.
pub(super) fn wire_picture(RequestedPicture { spec, format }: &RequestedPicture) -> v1::Picture {
    let jpeg_quality = match format {
        FrameFormat::Jpeg(quality) => quality.get().into(),
        FrameFormat::Png
        | FrameFormat::Rgb
        | FrameFormat::Rgba
        | FrameFormat::F32
        | FrameFormat::U32
        | FrameFormat::F32x3 => 0,
    };
    v1::Picture {
        width: spec.size.width,
        height: spec.size.height,
        format: wire_format(*format).into(),
        jpeg_quality,
        camera: Some(camera::wire_camera(spec.camera.at_rest())),
        edge_width: (spec.output == engine::FrameOutput::Color)
            .then(|| spec.style.edges.map_or(0.0, |edges| edges.width)),
        samples: spec.style.samples.unwrap_or_default(),
        ..output::wire_output(spec.output)
    }
}

/// Converts the optional step of a single request.
pub(super) const fn parse_step_selector(selector: Option<v1::StepSelector>) -> StepSelector {
    use v1::step_selector::Number;
    match selector {
        Some(v1::StepSelector { run, number: Some(Number::Exact(number)) }) => StepSelector::Exact { run, number },
        Some(v1::StepSelector { run, number: Some(Number::Minimum(number)) }) => StepSelector::Minimum { run, number },
        Some(v1::StepSelector { number: None, .. }) | None => StepSelector::Current,
    }
}

/// Describes the requested step, for errors.
pub(super) fn describe_step_selector(selector: StepSelector, scene: &str) -> String {
    match selector {
        StepSelector::Current => format!("the current step of scene '{scene}'"),
        StepSelector::Exact { number, .. } => format!("step {number} of scene '{scene}'"),
        StepSelector::Minimum { number, .. } => format!("step {number} or later of scene '{scene}'"),
    }
}

/// Limit on the hashes of one request.
const MAX_HASHES: usize = 4096;

/// Parses the field `sha256` of a request for contents.
pub(super) fn parse_hashes(list: &[Bytes]) -> Result<Vec<ContentHash>> {
    if list.is_empty() || list.len() > MAX_HASHES {
        return Err(invalid("sha256", format!("1 to {MAX_HASHES} hashes"), list.len()));
    }
    list.iter().enumerate().map(|(index, bytes)| parse_hash(&format!("sha256[{index}]"), bytes)).collect()
}

pub(super) fn parse_upload_header(header: v1::UploadHeader) -> engine::UploadHeader {
    engine::UploadHeader {
        scene: header.scene,
        entry: header.entry,
        files: header.files,
        total_bytes: header.total_bytes,
    }
}

pub(super) fn parse_array_upload_header(header: v1::UploadArraysHeader) -> Result<engine::ArrayUploadHeader> {
    let up = match header.up.as_str() {
        "x" => UpAxis::X,
        "" | "y" => UpAxis::Y,
        "z" => UpAxis::Z,
        other => return Err(invalid("header.up", "x, y or z", other)),
    };
    Ok(engine::ArrayUploadHeader {
        scene: header.scene,
        domains: header.domains,
        total_bytes: header.total_bytes,
        unit: if header.unit == 0.0 { 1.0 } else { header.unit },
        up,
    })
}

pub(super) fn parse_uploaded_domain(domain: v1::UploadedDomain) -> Result<engine::UploadedDomain> {
    let v1::UploadedDomain { vertices, triangles, rank, f64_positions, .. } = domain;
    let origin = match domain.origin[..] {
        [] => [0.0; 3],
        [x, y, z] => [x, y, z],
        _ => return Err(invalid("origin", "none or 3 numbers", domain.origin.len())),
    };
    let shape = match domain.shares_shape_with {
        None => UploadedShape::Arrays { vertices, triangles, rank, f64_positions, origin },
        Some(_) if f64_positions || !domain.origin.is_empty() => {
            return Err(invalid("origin, f64_positions", "neither with shares_shape_with", "one of them"));
        }
        Some(earlier) if (vertices, triangles, rank) == (0, 0, 0) => UploadedShape::OfDomain(earlier),
        Some(_) => {
            let given = format!("{vertices} vertices, {triangles} triangles, rank {rank}");
            return Err(invalid("shares_shape_with", "no arrays of its own", given));
        }
    };
    let placement = match domain.placement.len() {
        0 => Transform::IDENTITY.0.map(f64::from),
        48 => bytemuck::pod_read_unaligned::<[f32; 12]>(&domain.placement).map(f64::from),
        96 => bytemuck::pod_read_unaligned(&domain.placement),
        length => return Err(invalid("placement", "0, 48 or 96 bytes", format!("{length} bytes"))),
    };
    Transform::new(placement.map(|entry| entry as f32)).map_err(|error| error.in_message("placement"))?;
    let color = match domain.color[..] {
        [] => Material::UNSPECIFIED_COLOR,
        [red, green, blue] => [red, green, blue],
        _ => return Err(invalid("color", "none or 3 numbers", domain.color.len())),
    };
    let crease_angle = domain.crease_angle.map(CreaseAngle::from_degrees).transpose()?;
    Ok(engine::UploadedDomain {
        name: domain.name,
        shape,
        placement,
        color,
        eigenvalues: domain.eigenvalues,
        crease_angle,
    })
}
