//! Converts a primitive to a shape: one vertex per element of POSITION, triangles from its topology, and U (3n x r) from
//! the POSITION targets. A vertex has one corner, or one per normal if the primitive has no NORMAL and creases split it.

use super::accessor::{AccessorReader, AttributeFormat};
use super::document::Primitive;
use super::remarks::ImportRemarks;
use crate::domain::{Corners, CreaseAngle, MAX_RANK, Mesh, Modes, Shape, split_at_creases};
use crate::error::{Result, invalid};

/// Values of [`Primitive::mode`]; lower values are points and lines.
const TRIANGLES: u64 = 4;
const STRIP: u64 = 5;
const FAN: u64 = 6;

/// Converts a primitive to a shape, with the texture coordinates of set `uv_set` if the primitive has them. Returns
/// `None` for points and lines.
///
/// # Errors
/// `Invalid` with the attribute, the accessor and the field.
pub(super) fn convert_primitive(
    reader: AccessorReader<'_>,
    primitive: &Primitive,
    uv_set: u32,
    crease_angle: CreaseAngle,
    remarks: &mut ImportRemarks,
) -> Result<Option<Shape>> {
    if primitive.mode > FAN {
        return Err(invalid("mode", "0 to 6", primitive.mode));
    }
    if primitive.mode < TRIANGLES {
        remarks.add("primitives of points or lines are ignored".into());
        return Ok(None);
    }
    let position_accessor = primitive.attributes.get("POSITION");
    let position_accessor = *position_accessor.ok_or_else(|| invalid("attributes.POSITION", "an accessor", "none"))?;
    let format = AttributeFormat { allows_integers: false, count: None };
    let rest_positions = reader
        .decode_vectors::<3>(position_accessor, format)
        .map_err(|error| error.prefix_field("attributes.POSITION"))?;
    let modes = read_modes(reader, primitive, rest_positions.len(), remarks)?;
    let mesh = read_mesh(reader, primitive, rest_positions, uv_set, crease_angle)?;
    if primitive.attributes.contains_key("COLOR_0") {
        remarks.add("vertex colors are ignored".into());
    }
    Shape::new(mesh, modes).map(Some)
}

fn read_mesh(
    reader: AccessorReader<'_>,
    primitive: &Primitive,
    rest_positions: Vec<[f32; 3]>,
    uv_set: u32,
    crease_angle: CreaseAngle,
) -> Result<Mesh> {
    let indices = match primitive.indices {
        Some(accessor) => {
            reader.decode_indices(accessor, rest_positions.len()).map_err(|error| error.prefix_field("indices"))?
        }
        None => (0..rest_positions.len() as u32).collect(),
    };
    let triangles = build_triangles(&indices, primitive.mode)?;
    let format = AttributeFormat { allows_integers: false, count: Some(rest_positions.len()) };
    let normals = match primitive.attributes.get("NORMAL") {
        Some(accessor) => {
            Some(reader.decode_vectors(*accessor, format).map_err(|error| error.prefix_field("attributes.NORMAL"))?)
        }
        None => None,
    };
    let attribute = format!("TEXCOORD_{uv_set}");
    let format = AttributeFormat { allows_integers: true, ..format };
    let uvs: Vec<[f32; 2]> = match primitive.attributes.get(&attribute) {
        Some(accessor) => reader
            .decode_vectors(*accessor, format)
            .map_err(|error| error.prefix_field(&format!("attributes.{attribute}")))?,
        None => Vec::new(),
    };
    if let Some(normals) = normals {
        return Mesh::from_indexed(rest_positions, normals, uvs, triangles);
    }
    let vertices: Vec<u32> = (0..rest_positions.len() as u32).collect();
    let creased = split_at_creases(&rest_positions, &vertices, &triangles, &[], crease_angle);
    let uvs = creased.source_corners.iter().filter_map(|vertex| uvs.get(*vertex as usize).copied()).collect();
    let corners = Corners { vertices: creased.source_corners, normals: creased.normals, uvs };
    Mesh::new(rest_positions, corners, creased.triangles)
}

/// The triangles of a list, strip or fan. The degenerate triangles that connect strips are omitted.
fn build_triangles(indices: &[u32], mode: u64) -> Result<Vec<[u32; 3]>> {
    let is_valid_count = match mode {
        STRIP | FAN => indices.len() >= 3,
        _ => indices.len().is_multiple_of(3),
    };
    if !is_valid_count {
        let expected = if mode == TRIANGLES { "a multiple of 3 indices" } else { "at least 3 indices" };
        return Err(invalid("indices", expected, indices.len()));
    }
    Ok(match mode {
        STRIP => {
            let strip_triangle = |(index, window): (usize, &[u32])| match index % 2 {
                0 => [window[0], window[1], window[2]],
                _ => [window[0], window[2], window[1]],
            };
            let is_degenerate = |[a, b, c]: &[u32; 3]| a == b || b == c || a == c;
            indices.windows(3).enumerate().map(strip_triangle).filter(|triangle| !is_degenerate(triangle)).collect()
        }
        FAN => indices[1..].windows(2).map(|edge| [edge[0], edge[1], indices[0]]).collect(),
        _ => indices.as_chunks::<3>().0.to_vec(),
    })
}

/// Reads U. Column k is the POSITION attribute of target k, or zero if the target has none.
fn read_modes(
    reader: AccessorReader<'_>,
    primitive: &Primitive,
    vertex_count: usize,
    remarks: &mut ImportRemarks,
) -> Result<Modes> {
    let targets = &primitive.targets;
    if targets.len() > MAX_RANK {
        return Err(invalid("targets", format!("at most {MAX_RANK}"), targets.len()));
    }
    let mut columns = Vec::new();
    for (index, target) in targets.iter().enumerate() {
        for attribute in target.keys().filter(|attribute| *attribute != "POSITION") {
            remarks.add(match attribute.as_str() {
                "NORMAL" | "TANGENT" => {
                    format!("{attribute} targets are ignored: normals follow the displaced surface")
                }
                _ => format!("{attribute} targets are ignored"),
            });
        }
        let format = AttributeFormat { allows_integers: false, count: Some(vertex_count) };
        let column = match target.get("POSITION") {
            Some(accessor) => reader.decode_vectors::<3>(*accessor, format),
            None => reader.buffers.charge_budget(12 * vertex_count as u64).map(|()| vec![[0.0; 3]; vertex_count]),
        };
        let column = column.map_err(|error| error.prefix_field(&format!("targets[{index}].POSITION")))?;
        columns.extend_from_slice(column.as_flattened());
    }
    Ok(Modes::from_columns(3 * vertex_count, targets.len(), columns)?.without_zero_matrix())
}
