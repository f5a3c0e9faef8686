//! Parses the output and the format of a picture from the wire.

use modalcast_proto::v1;

use crate::engine::{Format, Showing, checked_mode};
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::Scene;

/// The end of a color map's scale must be below this value and at least its inverse.
const FARTHEST: f64 = 1e30;

/// Parses the output; returns it with a format that is valid for it.
pub(super) fn parse(scene: &Scene, picture: &v1::Picture) -> Result<(Showing, Format)> {
    let output = v1::Output::try_from(picture.output)
        .map_err(|_| invalid("picture.output", "an output of this version", picture.output))?;
    let is_map = matches!(output, v1::Output::Displacement | v1::Output::ModeShape);
    let largest = picture.largest;
    if largest != 0.0 && !(is_map && (1.0 / FARTHEST..FARTHEST).contains(&largest)) {
        let expected = format!("0, or for a colour map {:e} to {FARTHEST:e}", 1.0 / FARTHEST);
        return Err(invalid("picture.largest", expected, largest));
    }
    let showing = match output {
        v1::Output::Unspecified | v1::Output::Colour => Showing::Colour,
        v1::Output::Depth => Showing::Depth,
        v1::Output::Domains => Showing::Domains,
        v1::Output::Normals => Showing::Normals,
        v1::Output::Displacement => Showing::Displacement { largest },
        v1::Output::ModeShape => Showing::Mode { mode: checked_mode(scene, picture.mode)?, largest },
    };
    Ok((showing, format(showing, picture.format)?))
}

fn format(showing: Showing, number: i32) -> Result<Format> {
    let given =
        v1::Format::try_from(number).map_err(|_| invalid("picture.format", "a format of this version", number))?;
    let own = match showing {
        Showing::Colour | Showing::Displacement { .. } | Showing::Mode { .. } => None,
        Showing::Depth => Some((v1::Format::F32, Format::F32)),
        Showing::Domains => Some((v1::Format::U32, Format::U32)),
        Showing::Normals => Some((v1::Format::F32x3, Format::F32x3)),
    };
    match (own, given) {
        (None, v1::Format::Unspecified | v1::Format::Png) => Ok(Format::Png),
        (None, v1::Format::Rgba) => Ok(Format::Rgba),
        (None, other) => Err(invalid("picture.format", "PNG or RGBA for this output", other.as_str_name())),
        (Some((_, format)), v1::Format::Unspecified) => Ok(format),
        (Some((wire, format)), given) if wire == given => Ok(format),
        (Some((wire, _)), given) => {
            let expected = format!("{} or unspecified for this output", wire.as_str_name());
            Err(invalid("picture.format", expected, given.as_str_name()))
        }
    }
}
