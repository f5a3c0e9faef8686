//! Parses the output and the format of a picture from the wire.

use modalcast_proto::v1;

use crate::engine::{FrameFormat, FrameOutput, validate_mode};
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::Scene;

/// The end of a color map's scale must be below this value and at least its inverse.
const MAX_SCALE: f64 = 1e30;

/// Parses the output; returns it with a format that is valid for it.
pub(super) fn parse(scene: &Scene, picture: &v1::Picture) -> Result<(FrameOutput, FrameFormat)> {
    let output = v1::Output::try_from(picture.output)
        .map_err(|_| invalid("picture.output", "an output of this version", picture.output))?;
    let is_map = matches!(output, v1::Output::Displacement | v1::Output::ModeShape);
    let largest = picture.largest;
    if largest != 0.0 && !(is_map && (1.0 / MAX_SCALE..MAX_SCALE).contains(&largest)) {
        let expected = format!("0, or for a colour map {:e} to {MAX_SCALE:e}", 1.0 / MAX_SCALE);
        return Err(invalid("picture.largest", expected, largest));
    }
    let frame_output = match output {
        v1::Output::Unspecified | v1::Output::Colour => FrameOutput::Color,
        v1::Output::Depth => FrameOutput::Depth,
        v1::Output::Domains => FrameOutput::Domains,
        v1::Output::Normals => FrameOutput::Normals,
        v1::Output::Displacement => FrameOutput::Displacement { largest },
        v1::Output::ModeShape => FrameOutput::ModeShape { mode: validate_mode(scene, picture.mode)?, largest },
    };
    Ok((frame_output, format(frame_output, picture.format)?))
}

fn format(frame_output: FrameOutput, number: i32) -> Result<FrameFormat> {
    let given =
        v1::Format::try_from(number).map_err(|_| invalid("picture.format", "a format of this version", number))?;
    let own = match frame_output {
        FrameOutput::Color | FrameOutput::Displacement { .. } | FrameOutput::ModeShape { .. } => None,
        FrameOutput::Depth => Some((v1::Format::F32, FrameFormat::F32)),
        FrameOutput::Domains => Some((v1::Format::U32, FrameFormat::U32)),
        FrameOutput::Normals => Some((v1::Format::F32x3, FrameFormat::F32x3)),
    };
    match (own, given) {
        (None, v1::Format::Unspecified | v1::Format::Png) => Ok(FrameFormat::Png),
        (None, v1::Format::Rgba) => Ok(FrameFormat::Rgba),
        (None, other) => Err(invalid("picture.format", "PNG or RGBA for this output", other.as_str_name())),
        (Some((_, format)), v1::Format::Unspecified) => Ok(format),
        (Some((wire, format)), given) if wire == given => Ok(format),
        (Some((wire, _)), given) => {
            let expected = format!("{} or unspecified for this output", wire.as_str_name());
            Err(invalid("picture.format", expected, given.as_str_name()))
        }
    }
}
