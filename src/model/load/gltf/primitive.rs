//! Converts a primitive to a shape: one vertex per element of POSITION, triangles from its topology, and U (3n x r)
//! from the POSITION targets. A vertex has one corner, or one per normal if the primitive has no NORMAL and creases
//! split it.

use super::accessor::{AccessorReader, AttributeFormat};
use super::document::Primitive;
use super::remarks::ImportRemarks;
use crate::domain::{Corners, CreaseAngle, MAX_RANK, Mesh, Modes, Shape, Texture, split_at_creases};
use crate::error::{Result, invalid};
use crate::load::polygons::{VertexColors, paint};

/// Values of [`Primitive::mode`]; lower values are points and lines.
const TRIANGLES: u64 = 4;
const STRIP: u64 = 5;
const FAN: u64 = 6;

/// What the conversion of a primitive depends on besides the primitive.
#[derive(Debug, Clone, Copy)]
pub(super) struct PrimitiveOptions {
    /// The set of texture coordinates that the material uses.
    pub(super) uv_set: u32,
    /// Whether the material has an image.
    pub(super) has_image: bool,
    pub(super) crease_angle: CreaseAngle,
}

/// A primitive as a shape, and the colors of its vertices as factors of its material.
#[derive(Debug)]
pub(super) struct ConvertedPrimitive {
    pub(super) shape: Shape,
    pub(super) colors: PrimitiveColors,
    /// Whether the primitive has texture coordinates for the images of its material.
    pub(super) has_uvs: bool,
}

/// The colors of the vertices of a primitive.
#[derive(Debug)]
pub(super) enum PrimitiveColors {
    None,
    /// All vertices have this linear color.
    Uniform([f32; 3]),
    /// The texture coordinates of the shape refer to this image.
    Image(Texture),
}

/// Converts a primitive to a shape, with the texture coordinates of its material if the primitive has them. Returns
/// `None` for points and lines.
///
/// # Errors
/// `Invalid` with the attribute, the accessor and the field.
pub(super) fn convert_primitive(
    reader: AccessorReader<'_>,
    primitive: &Primitive,
    options: PrimitiveOptions,
    remarks: &mut ImportRemarks,
) -> Result<Option<ConvertedPrimitive>> {
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
    let mesh = read_mesh(reader, primitive, rest_positions, options)?;
    let has_uvs = !mesh.corners().uvs.is_empty();
    let (mesh, colors) = match primitive.attributes.get("COLOR_0") {
        None => (mesh, PrimitiveColors::None),
        // The colors are drawn through texture coordinates of their own.
        Some(_) if options.has_image && has_uvs => {
            remarks.add("vertex colors are not used where the material has an image".into());
            (mesh, PrimitiveColors::None)
        }
        Some(accessor) => {
            let colors = read_colors(reader, *accessor, mesh.rest_positions().len(), remarks);
            let colors = colors.map_err(|error| error.prefix_field("attributes.COLOR_0"))?;
            color_vertices(reader, mesh, &colors)?
        }
    };
    Ok(Some(ConvertedPrimitive { shape: Shape::new(mesh, modes)?, colors, has_uvs }))
}

/// The linear colors of the vertices. Their alpha is ignored.
fn read_colors(
    reader: AccessorReader<'_>,
    accessor: usize,
    vertex_count: usize,
    remarks: &mut ImportRemarks,
) -> Result<Vec<[f32; 3]>> {
    let format = AttributeFormat { allows_integers: true, count: Some(vertex_count) };
    let clamp = |channel: f32| channel.clamp(0.0, 1.0);
    if reader.document.accessors.get(accessor).is_none_or(|accessor| accessor.kind != "VEC4") {
        let colors = reader.decode_vectors::<3>(accessor, format)?;
        return Ok(colors.into_iter().map(|color| color.map(clamp)).collect());
    }
    let colors = reader.decode_vectors::<4>(accessor, format)?;
    if colors.iter().any(|color| color[3] < 1.0) {
        remarks.add("the alpha of vertex colors is ignored".into());
    }
    Ok(colors.into_iter().map(|[red, green, blue, _]| [red, green, blue].map(clamp)).collect())
}

/// Colors the vertices of a mesh.
fn color_vertices(
    reader: AccessorReader<'_>,
    mesh: Mesh,
    linear_colors: &[[f32; 3]],
) -> Result<(Mesh, PrimitiveColors)> {
    // Four texels per triangle.
    reader.buffers.charge_budget(16 * mesh.triangles().len() as u64)?;
    Ok(match paint(&mesh, linear_colors)? {
        VertexColors::Uniform(color) => (mesh, PrimitiveColors::Uniform(color)),
        VertexColors::Image(painted) => {
            let (mesh, texture) = *painted;
            (mesh, PrimitiveColors::Image(texture))
        }
    })
}

fn read_mesh(
    reader: AccessorReader<'_>,
    primitive: &Primitive,
    rest_positions: Vec<[f32; 3]>,
    PrimitiveOptions { uv_set, crease_angle, .. }: PrimitiveOptions,
) -> Result<Mesh> {
    let indices = match primitive.indices {
        Some(accessor) => {
            reader.decode_indices(accessor, rest_positions.len()).map_err(|error| error.prefix_field("indices"))?
        }
        None => (0..rest_positions.len() as u32).collect(),
    };
    // A strip has at most as many triangles as indices.
    let max_triangles = if primitive.mode == TRIANGLES { indices.len() / 3 } else { indices.len() };
    reader.buffers.reserve_mesh(rest_positions.len(), max_triangles)?;
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
