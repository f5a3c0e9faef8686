//! Converts the output and the format of a picture.

use modalcast_proto::v1;

use crate::engine::{FrameFormat, FrameOutput, JpegQuality, validate_mode};
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::{FrameStyle, MeshEdges, Scene};

/// Upper limit of the value at the end of a color map's scale. The lower limit is 1 / `MAX_SCALE`.
const MAX_SCALE: f64 = 1e30;

/// Parses the output and the format of a picture. Fails if the output does not have this format. The field of an error
/// is relative to the picture.
pub(super) fn parse_output(scene: &Scene, picture: &v1::Picture) -> Result<(FrameOutput, FrameFormat)> {
    let output = v1::Output::try_from(picture.output)
        .map_err(|_| invalid("output", "an output of this version", picture.output))?;
    let is_color_map = matches!(output, v1::Output::Displacement | v1::Output::ModeShape);
    let scale_max = picture.largest;
    if scale_max != 0.0 && !(is_color_map && (1.0 / MAX_SCALE..=MAX_SCALE).contains(&scale_max)) {
        let expected = format!("0, or for a color map {:e} to {MAX_SCALE:e}", 1.0 / MAX_SCALE);
        return Err(invalid("largest", expected, scale_max));
    }
    let frame_output = match output {
        v1::Output::Unspecified | v1::Output::Color => FrameOutput::Color,
        v1::Output::Depth => FrameOutput::Depth,
        v1::Output::DepthWithGround => FrameOutput::DepthWithGround,
        v1::Output::Domains => FrameOutput::Domains,
        v1::Output::Normals => FrameOutput::Normals,
        v1::Output::Displacement => FrameOutput::Displacement { scale_max },
        v1::Output::ModeShape => FrameOutput::ModeShape { mode: validate_mode(scene, picture.mode)?, scale_max },
    };
    Ok((frame_output, parse_format(frame_output, picture)?))
}

/// How the frames of a request are looked at, which chooses their samples per pixel if nothing else does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::service) enum FrameUse {
    /// A single request.
    Still,
    Stream,
}

/// Parses what a picture sets for itself. The field of an error is relative to the picture.
pub(super) fn parse_style(
    scene: &Scene,
    output: FrameOutput,
    picture: &v1::Picture,
    frame_use: FrameUse,
) -> Result<FrameStyle> {
    let edges = parse_edges(scene, output, picture.edge_width)?;
    let is_color = output == FrameOutput::Color;
    let samples = match picture.samples {
        0 => scene.look.still_samples().filter(|_| is_color && frame_use == FrameUse::Still),
        samples if !is_color => return Err(invalid("samples", "0 unless the output is OUTPUT_COLOR", samples)),
        samples @ (1 | 4) => Some(samples),
        samples => return Err(invalid("samples", "0, 1 or 4", samples)),
    };
    Ok(FrameStyle { edges, samples })
}

/// Parses the width in pixels of lines along mesh edges. 0 means no lines. The color, and an unset width, are those of
/// `look.edges` in the scene's scene.toml.
fn parse_edges(scene: &Scene, output: FrameOutput, width: Option<f32>) -> Result<Option<MeshEdges>> {
    let look_edges = scene.look.edges.filter(|_| output == FrameOutput::Color);
    let Some(width) = width else { return Ok(look_edges) };
    if output != FrameOutput::Color && width != 0.0 {
        return Err(invalid("edge_width", "0 or unset unless the output is OUTPUT_COLOR", width));
    }
    if width == 0.0 {
        return Ok(None);
    }
    let edges = look_edges.unwrap_or_default().with_width(width);
    match edges.has_valid_width() {
        true => Ok(Some(edges)),
        false => Err(invalid("edge_width", format!("0 to {} pixels", MeshEdges::MAX_WIDTH), width)),
    }
}

/// Parses a format. Unspecified is PNG for color frames and color maps, else the only format of the output.
fn parse_format(frame_output: FrameOutput, picture: &v1::Picture) -> Result<FrameFormat> {
    let requested_format = v1::Format::try_from(picture.format)
        .map_err(|_| invalid("format", "a format of this version", picture.format))?;
    if picture.jpeg_quality != 0 && requested_format != v1::Format::Jpeg {
        return Err(invalid("jpeg_quality", "0 unless the format is FORMAT_JPEG", picture.jpeg_quality));
    }
    // The only format of the output, as wire and engine types; `None` for outputs with a choice.
    let required_format = match frame_output {
        FrameOutput::Color | FrameOutput::Displacement { .. } | FrameOutput::ModeShape { .. } => None,
        FrameOutput::Depth | FrameOutput::DepthWithGround => Some((v1::Format::F32, FrameFormat::F32)),
        FrameOutput::Domains => Some((v1::Format::U32, FrameFormat::U32)),
        FrameOutput::Normals => Some((v1::Format::F32x3, FrameFormat::F32x3)),
    };
    match (required_format, requested_format) {
        (None, v1::Format::Unspecified | v1::Format::Png) => Ok(FrameFormat::Png),
        (None, v1::Format::Jpeg) => JpegQuality::parse("jpeg_quality", picture.jpeg_quality).map(FrameFormat::Jpeg),
        (None, v1::Format::Rgb) => Ok(FrameFormat::Rgb),
        (None, v1::Format::Rgba) => Ok(FrameFormat::Rgba),
        (None, other) => {
            let expected = "FORMAT_PNG, FORMAT_JPEG, FORMAT_RGB or FORMAT_RGBA for this output";
            Err(invalid("format", expected, other.as_str_name()))
        }
        (Some((_, format)), v1::Format::Unspecified) => Ok(format),
        (Some((wire_format, format)), _) if wire_format == requested_format => Ok(format),
        (Some((wire_format, _)), _) => {
            let expected = format!("{} or unspecified for this output", wire_format.as_str_name());
            Err(invalid("format", expected, requested_format.as_str_name()))
        }
    }
}

/// A picture with only the fields of its output.
pub(super) fn wire_output(output: FrameOutput) -> v1::Picture {
    let (mode, largest) = match output {
        FrameOutput::Displacement { scale_max } => (0, scale_max),
        FrameOutput::ModeShape { mode, scale_max } => (mode, scale_max),
        _ => (0, 0.0),
    };
    v1::Picture { output: wire_frame_output(output).into(), mode, largest, ..v1::Picture::default() }
}

/// The name of an output.
pub(in crate::service) const fn wire_frame_output(output: FrameOutput) -> v1::Output {
    match output {
        FrameOutput::Color => v1::Output::Color,
        FrameOutput::Depth => v1::Output::Depth,
        FrameOutput::DepthWithGround => v1::Output::DepthWithGround,
        FrameOutput::Domains => v1::Output::Domains,
        FrameOutput::Normals => v1::Output::Normals,
        FrameOutput::Displacement { .. } => v1::Output::Displacement,
        FrameOutput::ModeShape { .. } => v1::Output::ModeShape,
    }
}

pub(crate) const fn wire_format(format: FrameFormat) -> v1::Format {
    match format {
        FrameFormat::Png => v1::Format::Png,
        FrameFormat::Jpeg(_) => v1::Format::Jpeg,
        FrameFormat::Rgb => v1::Format::Rgb,
        FrameFormat::Rgba => v1::Format::Rgba,
        FrameFormat::F32 => v1::Format::F32,
        FrameFormat::U32 => v1::Format::U32,
        FrameFormat::F32x3 => v1::Format::F32x3,
    }
}
