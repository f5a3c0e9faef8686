//! Converts a primitive to a shape: one vertex per element of POSITION, triangles from its topology, and U (3n x r)
//! from the POSITION targets. A vertex has one corner, or one per normal if the primitive has no NORMAL and creases
//! split it.

use std::ops::RangeInclusive;

use nalgebra::Matrix4;

use super::accessor::{AccessorReader, AttributeFormat, ComponentTypes};
use super::document::{Primitive, TextureTransform};
use super::remarks::ImportRemarks;
use super::skin::Pose;
use crate::domain::{Corners, CreaseAngle, MAX_RANK, Mesh, Modes, RestOrigin, split_at_creases};
use crate::error::{Result, invalid};
use crate::load::values::CorrectedValue;

/// Values of [`Primitive::mode`]; lower values are points and lines.
const TRIANGLES: u64 = 4;
const STRIP: u64 = 5;
const FAN: u64 = 6;
/// The texture coordinates inside of an image, up to rounding.
const UV_RANGE: RangeInclusive<f32> = -1e-3..=1.001;

/// What the conversion of a primitive depends on besides the primitive.
#[derive(Debug, Clone, Copy)]
pub(super) struct PrimitiveOptions<'a> {
    /// The set of texture coordinates that the material uses.
    pub(super) uv_set: u32,
    /// The transform of the texture coordinates.
    pub(super) uv_transform: TextureTransform,
    /// Whether the image of the material repeats along u and along v.
    pub(super) repeats: [bool; 2],
    pub(super) crease_angle: CreaseAngle,
    /// The matrices of the joints, if the node has a skin.
    pub(super) joint_matrices: Option<&'a [Matrix4<f64>]>,
}

/// The mesh and the modes of a primitive, and the colors of its vertices as factors of its material.
#[derive(Debug)]
pub(super) struct ConvertedPrimitive {
    pub(super) mesh: Mesh,
    /// The point that the positions of the mesh are relative to.
    pub(super) origin: [f64; 3],
    pub(super) modes: Modes,
    /// Linear colors of the vertices with alpha, 0 to 1; empty if they have none.
    pub(super) colors: Vec<[f32; 4]>,
    /// Whether a morph target has normals.
    pub(super) has_target_normals: bool,
}

/// Converts a primitive to a shape, with the texture coordinates of its material if the primitive has them. Returns
/// `None` for points and lines.
///
/// # Errors
/// `Invalid` with the attribute, the accessor and the field.
pub(super) fn convert_primitive(
    reader: AccessorReader<'_>,
    primitive: &Primitive,
    options: PrimitiveOptions<'_>,
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
    let format = AttributeFormat { components: ComponentTypes::Quantized, count: None };
    let mut rest_positions = reader
        .decode_vectors::<3>(position_accessor, format)
        .map_err(|error| error.prefix_field("attributes.POSITION"))?;
    let vertex_count = rest_positions.len();
    let pose = match options.joint_matrices {
        Some(matrices) => Some(Pose::read(reader, primitive, matrices, vertex_count)?),
        None => None,
    };
    if let Some(pose) = &pose {
        pose.move_positions(&mut rest_positions);
    }
    let modes = read_modes(reader, primitive, vertex_count, pose.as_ref(), remarks)?;
    let (mesh, origin) = read_mesh(reader, primitive, rest_positions, (options, pose.as_ref()), remarks)?;
    let colors = match primitive.attributes.get("COLOR_0") {
        None => Vec::new(),
        Some(accessor) => {
            let colors = read_colors(reader, *accessor, vertex_count, remarks);
            colors.map_err(|error| error.prefix_field("attributes.COLOR_0"))?
        }
    };
    let has_target_normals = primitive.targets.iter().any(|target| target.contains_key("NORMAL"));
    Ok(Some(ConvertedPrimitive { mesh, origin, modes, colors, has_target_normals }))
}

/// The linear colors of the vertices with alpha.
fn read_colors(
    reader: AccessorReader<'_>,
    accessor: usize,
    vertex_count: usize,
    remarks: &mut ImportRemarks,
) -> Result<Vec<[f32; 4]>> {
    let format = AttributeFormat { components: ComponentTypes::UnitInterval, count: Some(vertex_count) };
    let has_alpha = reader.document.accessors.get(accessor).is_some_and(|accessor| accessor.kind == "VEC4");
    let (mut colors, alphas): (Vec<[f32; 3]>, Vec<f32>) = if has_alpha {
        let colors = reader.decode_vectors::<4>(accessor, format)?;
        colors.into_iter().map(|[red, green, blue, alpha]| ([red, green, blue], alpha)).unzip()
    } else {
        (reader.decode_vectors::<3>(accessor, format)?, vec![1.0; vertex_count])
    };
    remarks.corrections.vertex_colors(&mut colors, 0);
    let mut alpha_in_range =
        |alpha: f32| remarks.corrections.in_range("alpha of a vertex", alpha, [0.0, 1.0], "1 is used").unwrap_or(1.0);
    let colors = colors.into_iter().zip(alphas);
    Ok(colors.map(|([red, green, blue], alpha)| [red, green, blue, alpha_in_range(alpha)]).collect())
}

/// Reads the mesh and the origin of its rest positions.
fn read_mesh(
    reader: AccessorReader<'_>,
    primitive: &Primitive,
    mut file_positions: Vec<[f32; 3]>,
    (options, pose): (PrimitiveOptions<'_>, Option<&Pose>),
    remarks: &mut ImportRemarks,
) -> Result<(Mesh, [f64; 3])> {
    let PrimitiveOptions { uv_set, crease_angle, uv_transform, repeats, .. } = options;
    let indices = match primitive.indices {
        Some(accessor) => {
            reader.decode_indices(accessor, file_positions.len()).map_err(|error| error.prefix_field("indices"))?
        }
        None => (0..file_positions.len() as u32).collect(),
    };
    // A strip has at most as many triangles as indices.
    let max_triangles = if primitive.mode == TRIANGLES { indices.len() / 3 } else { indices.len() };
    reader.buffers.reserve_mesh(file_positions.len(), max_triangles)?;
    let triangles = build_triangles(&indices, primitive.mode)?;
    check_positions(&mut file_positions, &triangles, remarks)?;
    let exact_positions: Vec<[f64; 3]> = file_positions.iter().map(|position| position.map(f64::from)).collect();
    let drawn = triangles.as_flattened().iter().map(|vertex| *vertex as usize);
    let RestOrigin { origin, positions: rest_positions } = RestOrigin::choose(&exact_positions, drawn);
    drop(exact_positions);
    let format = AttributeFormat { components: ComponentTypes::Quantized, count: Some(rest_positions.len()) };
    let mut normals = match primitive.attributes.get("NORMAL") {
        Some(accessor) => {
            reader.decode_vectors::<3>(*accessor, format).map_err(|error| error.prefix_field("attributes.NORMAL"))?
        }
        None => Vec::new(),
    };
    if let Some(pose) = pose {
        pose.move_normals(&mut normals);
    }
    remarks.corrections.zero_non_finite("attributes.NORMAL", "the normal is computed", &mut normals, 0);
    let attribute = format!("TEXCOORD_{uv_set}");
    let mut uvs: Vec<[f32; 2]> = match primitive.attributes.get(&attribute) {
        Some(accessor) => reader
            .decode_vectors(*accessor, format)
            .map_err(|error| error.prefix_field(&format!("attributes.{attribute}")))?,
        None => Vec::new(),
    };
    if uv_transform != TextureTransform::default() {
        uvs.iter_mut().for_each(|uv| *uv = uv_transform.apply(*uv));
    }
    remarks.corrections.zero_non_finite(&format!("attributes.{attribute}"), "(0, 0) is used", &mut uvs, 0);
    let leaves_image = |axis: usize| uvs.iter().any(|uv| !UV_RANGE.contains(&uv[axis]));
    if (0..2).any(|axis| !repeats[axis] && leaves_image(axis)) {
        remarks.add("samplers that clamp or mirror are ignored: textures repeat".into());
    }
    let file_normals: Vec<Option<[f32; 3]>> =
        normals.iter().map(|normal| Some(*normal).filter(|normal| *normal != [0.0; 3])).collect();
    if !normals.is_empty() && file_normals.iter().all(Option::is_some) {
        return Mesh::from_indexed(rest_positions, normals, uvs, triangles).map(|mesh| (mesh, origin));
    }
    let vertices: Vec<u32> = (0..rest_positions.len() as u32).collect();
    let creased = split_at_creases(&rest_positions, &vertices, &triangles, &file_normals, crease_angle);
    let uvs = creased.source_corners.iter().filter_map(|vertex| uvs.get(*vertex as usize).copied()).collect();
    let corners = Corners { vertices: creased.source_corners, normals: creased.normals, uvs };
    Mesh::new(rest_positions, corners, creased.triangles).map(|mesh| (mesh, origin))
}

/// Checks that the positions of all triangles are finite, and replaces those of other vertices.
fn check_positions(positions: &mut [[f32; 3]], triangles: &[[u32; 3]], remarks: &mut ImportRemarks) -> Result<()> {
    let is_finite = |position: &[f32; 3]| position.iter().all(|number| number.is_finite());
    if positions.iter().all(is_finite) {
        return Ok(());
    }
    if let Some(vertex) = triangles.as_flattened().iter().find(|vertex| !is_finite(&positions[**vertex as usize])) {
        let given = format!("{:?}", positions[*vertex as usize]);
        return Err(invalid(format!("attributes.POSITION: element {vertex}"), "finite numbers", given));
    }
    let used_position = triangles.first().map_or([0.0; 3], |triangle| positions[triangle[0] as usize]);
    for (vertex, position) in positions.iter_mut().enumerate().filter(|(_, position)| !is_finite(position)) {
        let value = || CorrectedValue::new(format!("element {vertex}"), "finite numbers", format!("{position:?}"));
        remarks.corrections.add("attributes.POSITION", "no triangle uses the vertex", value);
        *position = used_position;
    }
    Ok(())
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
    pose: Option<&Pose>,
    remarks: &mut ImportRemarks,
) -> Result<Modes> {
    let targets = &primitive.targets;
    if targets.len() > MAX_RANK {
        return Err(invalid("targets", format!("at most {MAX_RANK}"), targets.len()));
    }
    let mut columns = Vec::new();
    for (index, target) in targets.iter().enumerate() {
        for attribute in target.keys().filter(|attribute| *attribute != "POSITION") {
            // Exact normals replace the normals and tangents of targets.
            if !matches!(attribute.as_str(), "NORMAL" | "TANGENT") {
                remarks.add(format!("{attribute} targets are ignored"));
            }
        }
        let format = AttributeFormat { components: ComponentTypes::Quantized, count: Some(vertex_count) };
        let column = match target.get("POSITION") {
            Some(accessor) => reader.decode_vectors::<3>(*accessor, format),
            None => reader.buffers.charge_budget(12 * vertex_count as u64).map(|()| vec![[0.0; 3]; vertex_count]),
        };
        let in_target = |error: crate::error::Error| error.prefix_field(&format!("targets[{index}].POSITION"));
        let mut column = column.map_err(in_target)?;
        if let Some(vertex) = column.iter().position(|entry| entry.iter().any(|number| !number.is_finite())) {
            let given = format!("{:?}", column[vertex]);
            return Err(in_target(invalid(format!("element {vertex}"), "finite numbers", given)));
        }
        if let Some(pose) = pose {
            pose.move_displacements(&mut column);
        }
        columns.extend_from_slice(column.as_flattened());
    }
    Ok(Modes::from_columns(3 * vertex_count, targets.len(), columns)?.without_zero_matrix())
}
