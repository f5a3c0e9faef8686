//! Converts a primitive to a shape: one vertex and one corner per element of POSITION, triangles from its topology, and
//! U (3n x r) from the POSITION targets.

use super::accessor::{AccessorReader, AttributeFormat};
use super::document::Primitive;
use super::warnings::ImportWarnings;
use crate::domain::{MAX_RANK, Mesh, Modes, Shape, smooth_normals};
use crate::error::{Result, invalid};

const STRIP: u64 = 5;
const FAN: u64 = 6;

/// The shape of a primitive, with the texture coordinates of set `uv_set` if it has them. `None` for points and lines.
///
/// # Errors
/// `Invalid` with the attribute, the accessor and the field.
pub(super) fn shape(
    reader: AccessorReader<'_>,
    primitive: &Primitive,
    uv_set: u32,
    remarks: &mut ImportWarnings,
) -> Result<Option<Shape>> {
    if primitive.mode > FAN {
        return Err(invalid("mode", "0 to 6", primitive.mode));
    }
    if primitive.mode < 4 {
        remarks.add("primitives of points or lines are left out".into());
        return Ok(None);
    }
    let positions = primitive.attributes.get("POSITION");
    let positions = *positions.ok_or_else(|| invalid("attributes.POSITION", "an accessor", "none"))?;
    let form = AttributeFormat { integers: false, count: None };
    let rest = reader.vectors::<3>(positions, form).map_err(|error| error.prefix_field("attributes.POSITION"))?;
    let modes = modes(reader, primitive, rest.len(), remarks)?;
    let mesh = mesh(reader, primitive, rest, uv_set)?;
    if primitive.attributes.contains_key("COLOR_0") {
        remarks.add("vertex colours are ignored".into());
    }
    Shape::new(mesh, modes).map(Some)
}

fn mesh(reader: AccessorReader<'_>, primitive: &Primitive, rest: Vec<[f32; 3]>, uv_set: u32) -> Result<Mesh> {
    let indices = match primitive.indices {
        Some(accessor) => reader.indices(accessor, rest.len()).map_err(|error| error.prefix_field("indices"))?,
        None => (0..rest.len() as u32).collect(),
    };
    let triangles = triangles(&indices, primitive.mode)?;
    let form = AttributeFormat { integers: false, count: Some(rest.len()) };
    let normals = match primitive.attributes.get("NORMAL") {
        Some(accessor) => reader.vectors(*accessor, form).map_err(|error| error.prefix_field("attributes.NORMAL"))?,
        None => {
            let vertices: Vec<u32> = (0..rest.len() as u32).collect();
            smooth_normals(&rest, &vertices, &triangles)
        }
    };
    let attribute = format!("TEXCOORD_{uv_set}");
    let form = AttributeFormat { integers: true, ..form };
    let uvs = match primitive.attributes.get(&attribute) {
        Some(accessor) => {
            reader.vectors(*accessor, form).map_err(|error| error.prefix_field(&format!("attributes.{attribute}")))?
        }
        None => Vec::new(),
    };
    Mesh::from_indexed(rest, normals, uvs, triangles)
}

/// The triangles of a list, strip or fan. Degenerate triangles that join strips are omitted.
fn triangles(indices: &[u32], mode: u64) -> Result<Vec<[u32; 3]>> {
    let wanted = match mode {
        STRIP | FAN => indices.len() >= 3,
        _ => indices.len().is_multiple_of(3),
    };
    if !wanted {
        let expected = if mode == 4 { "a multiple of 3 indices" } else { "at least 3 indices" };
        return Err(invalid("indices", expected, indices.len()));
    }
    Ok(match mode {
        STRIP => {
            let turned = |(at, triple): (usize, &[u32])| match at % 2 {
                0 => [triple[0], triple[1], triple[2]],
                _ => [triple[0], triple[2], triple[1]],
            };
            let stitch = |[a, b, c]: &[u32; 3]| a == b || b == c || a == c;
            indices.windows(3).enumerate().map(turned).filter(|triangle| !stitch(triangle)).collect()
        }
        FAN => indices[1..].windows(2).map(|pair| [pair[0], pair[1], indices[0]]).collect(),
        _ => indices.as_chunks::<3>().0.to_vec(),
    })
}

/// Column k of U is the POSITION of target k, or zero if the target has none.
fn modes(
    reader: AccessorReader<'_>,
    primitive: &Primitive,
    vertices: usize,
    remarks: &mut ImportWarnings,
) -> Result<Modes> {
    let targets = &primitive.targets;
    if targets.len() > MAX_RANK {
        return Err(invalid("targets", format!("at most {MAX_RANK}"), targets.len()));
    }
    let mut columns = Vec::new();
    for (at, target) in targets.iter().enumerate() {
        for other in target.keys().filter(|attribute| *attribute != "POSITION") {
            remarks.add(match other.as_str() {
                "NORMAL" | "TANGENT" => format!("{other} targets are ignored: normals follow the displaced surface"),
                _ => format!("{other} targets are ignored"),
            });
        }
        let form = AttributeFormat { integers: false, count: Some(vertices) };
        let column = match target.get("POSITION") {
            Some(accessor) => reader.vectors::<3>(*accessor, form),
            None => reader.bytes.charge_budget(12 * vertices as u64).map(|()| vec![[0.0; 3]; vertices]),
        };
        let column = column.map_err(|error| error.prefix_field(&format!("targets[{at}].POSITION")))?;
        columns.extend_from_slice(column.as_flattened());
    }
    Ok(Modes::from_columns(3 * vertices, targets.len(), columns)?.without_zero_matrix())
}
