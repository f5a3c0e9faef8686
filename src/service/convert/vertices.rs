//! Conversions of selections and sections of vertices.

use std::sync::Arc;

use modalcast_proto::v1;

use crate::engine::{Attribute, Encoding, Section, VertexSelection};
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::Scene;

/// Validates the selection of a request. An unset selection is the default one.
pub(crate) fn parse_vertex_selection(
    scene: &Arc<Scene>,
    selection: Option<v1::VertexSelection>,
) -> Result<Arc<VertexSelection>> {
    let v1::VertexSelection { domains, attributes } = selection.unwrap_or_default();
    let attributes = attributes
        .iter()
        .enumerate()
        .map(|(index, selected)| {
            parse_selected(*selected).map_err(|error| error.in_message(&format!("selection.attributes[{index}]")))
        })
        .collect::<Result<_>>()?;
    VertexSelection::new(scene, domains, attributes).map(Arc::new)
}

/// Parses a selected attribute. Errors name attributes and encodings as the contract does.
fn parse_selected(selected: v1::SelectedAttribute) -> Result<(Attribute, Encoding)> {
    let attribute = match parse_attribute(selected.attribute) {
        Some(Attribute::Origins) => {
            return Err(invalid("attribute", "an attribute that can be selected", selected.attribute().as_str_name()));
        }
        Some(attribute) => attribute,
        None => return Err(invalid("attribute", "an attribute of this version", selected.attribute)),
    };
    let encoding = parse_encoding(selected.encoding)
        .ok_or_else(|| invalid("encoding", "an encoding of this version", selected.encoding))?;
    if attribute.encodings().contains(&encoding) {
        return Ok((attribute, encoding));
    }
    let names: Vec<_> = attribute.encodings().iter().map(|encoding| wire_encoding(*encoding).as_str_name()).collect();
    let expected = format!("{} for {}", names.join(", "), selected.attribute().as_str_name());
    Err(invalid("encoding", expected, selected.encoding().as_str_name()))
}

fn parse_attribute(number: i32) -> Option<Attribute> {
    match v1::Attribute::try_from(number) {
        Ok(v1::Attribute::Positions) => Some(Attribute::Positions),
        Ok(v1::Attribute::Normals) => Some(Attribute::Normals),
        Ok(v1::Attribute::Displacements) => Some(Attribute::Displacements),
        Ok(v1::Attribute::Boxes) => Some(Attribute::Boxes),
        Ok(v1::Attribute::Origins) => Some(Attribute::Origins),
        Ok(v1::Attribute::Unspecified) | Err(_) => None,
    }
}

/// Parses an encoding; unspecified means f32.
fn parse_encoding(number: i32) -> Option<Encoding> {
    match v1::Encoding::try_from(number) {
        Ok(v1::Encoding::Unspecified | v1::Encoding::F32) => Some(Encoding::F32),
        Ok(v1::Encoding::F16) => Some(Encoding::F16),
        Ok(v1::Encoding::U16Box) => Some(Encoding::U16Box),
        Ok(v1::Encoding::OctahedralI16) => Some(Encoding::OctahedralI16),
        Ok(v1::Encoding::F64) => Some(Encoding::F64),
        Err(_) => None,
    }
}

pub(crate) fn wire_sections(sections: &[Section]) -> Vec<v1::VertexSection> {
    let wire_section = |section: &Section| {
        let attribute = match section.attribute {
            Attribute::Positions => v1::Attribute::Positions,
            Attribute::Normals => v1::Attribute::Normals,
            Attribute::Displacements => v1::Attribute::Displacements,
            Attribute::Boxes => v1::Attribute::Boxes,
            Attribute::Origins => v1::Attribute::Origins,
        };
        v1::VertexSection {
            attribute: attribute.into(),
            encoding: wire_encoding(section.encoding).into(),
            offset: section.offset,
            bytes: section.bytes,
        }
    };
    sections.iter().map(wire_section).collect()
}

const fn wire_encoding(encoding: Encoding) -> v1::Encoding {
    match encoding {
        Encoding::F32 => v1::Encoding::F32,
        Encoding::F16 => v1::Encoding::F16,
        Encoding::U16Box => v1::Encoding::U16Box,
        Encoding::OctahedralI16 => v1::Encoding::OctahedralI16,
        Encoding::F64 => v1::Encoding::F64,
    }
}
