//! Writes recordings as binary glTF: modes are morph targets, and an animation sets their weights q and the transforms
//! T.

use std::collections::HashMap;
use std::path::Path;

use glam::{DMat3, DQuat, DVec3};
use modalcast_client::{AlphaMode, Domain, Material, MaterialRange, SceneDescription, Shape, ShapeArray, Texture};
use serde_json::{Map, Value, json};

use super::check_slow;
use super::glb::{Element, GlbBuilder};
use super::tracks::{Matrix3x4, StateTimes, Track, for_each_track};
use crate::error::{Error, Result};
use crate::reader::Recording;

/// Largest cosine of the angle between the axes of a transform without shear.
const SHEAR_TOLERANCE: f64 = 1e-5;

/// Writes a `.glb` file. Each domain is a node with a mesh, whose morph targets are the columns of U; domains of the
/// same shape and materials share their mesh. The animation has one key frame per state, with linear interpolation. Of
/// several states at the same time, the last one is used. Normals are those of the rest shape. The Phong materials are
/// approximated. A second of the motion lasts `slow` seconds.
///
/// # Errors
/// `Invalid` if `slow` is no positive number, a transform has shear or a scale of 0, which a node cannot express, or the
/// file exceeds 4 GiB; `Unavailable` if the recording has only the hashes of its contents; `InvalidFile` if it is
/// damaged; `File` if the file cannot be written.
pub fn export_gltf(recording: &Recording, slow: f64, out: &Path) -> Result<()> {
    check_slow(slow)?;
    let arrays = [
        ShapeArray::Indices,
        ShapeArray::CornerVertices,
        ShapeArray::RestPositions,
        ShapeArray::CenteredPositions,
        ShapeArray::Uvs,
        ShapeArray::RestNormals,
        ShapeArray::Modes,
    ];
    let description = recording.read_description(&arrays, true)?;
    let mut glb = GlbBuilder::new(out)?;
    let mut meshes = Meshes::default();
    let mesh_indices = description
        .domains
        .iter()
        .map(|domain| meshes.mesh_of(&mut glb, &description, domain))
        .collect::<Result<Vec<_>>>()?;
    let images = description.textures.iter().map(|texture| image(&mut glb, texture)).collect::<Result<Vec<_>>>()?;

    let selected = StateTimes::read_increasing(recording, slow)?;
    let times: Vec<f32> = selected.times.iter().map(|time| *time as f32).collect();
    let input = glb.add_floats(Element::Scalar, &times)?;
    let offset = scene_offset(&description);
    let mut animation = Animation { input, offset, samplers: Vec::new(), channels: Vec::new() };
    let mut nodes = Vec::new();
    for_each_track(recording, &selected, |index, track| {
        let domain = &description.domains[index];
        let place = DomainPlace { mesh: mesh_indices[index], origin: description.shapes[domain.shape].origin };
        nodes.push(animation.add_domain(&mut glb, domain, place, &track, &selected)?);
        Ok(())
    })?;

    let mut document = Map::new();
    let mut insert = |key: &str, value: Value| {
        let is_empty = value.as_array().is_some_and(Vec::is_empty);
        if !is_empty {
            document.insert(key.to_owned(), value);
        }
    };
    let textures: Vec<Value> = (0..images.len()).map(|source| json!({ "source": source })).collect();
    let children: Vec<usize> = (0..nodes.len()).collect();
    nodes.push(root_node(&description, offset, children));
    insert("asset", json!({ "version": "2.0", "generator": concat!("modalcast-record ", env!("CARGO_PKG_VERSION")) }));
    insert("scene", json!(0));
    insert("scenes", json!([{ "nodes": [nodes.len() - 1] }]));
    insert("meshes", meshes.meshes.into());
    insert("materials", description.materials.iter().map(material).collect());
    insert("images", images.into());
    insert("textures", textures.into());
    insert("nodes", nodes.into());
    if !animation.channels.is_empty() {
        insert("animations", json!([{ "samplers": animation.samplers, "channels": animation.channels }]));
    }
    glb.finish(document)
}

/// The point that the translations of the nodes are relative to, in scene units: zero, or the place of the first domain
/// in a scene that is far from its origin. Programs that read glTF compute in f32.
fn scene_offset(description: &SceneDescription) -> [f64; 3] {
    let shape_of = |domain: &Domain| &description.shapes[domain.shape];
    let is_far =
        |domain: &Domain| shape_of(domain).has_origin() || domain.exact_placement != domain.placement.map(f64::from);
    match description.domains.first() {
        Some(first) if description.domains.iter().any(is_far) => {
            apply(&first.exact_placement, shape_of(first).origin).map(f64::round)
        }
        _ => [0.0; 3],
    }
}

/// A transform of a point.
fn apply(matrix: &Matrix3x4, point: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|row| {
        let entries = &matrix[4 * row..][..4];
        entries[0] * point[0] + entries[1] * point[1] + entries[2] * point[2] + entries[3]
    })
}

/// The node of the scene: scales to meters, turns the up axis to y, and moves by the offset of the other nodes.
fn root_node(description: &SceneDescription, offset: [f64; 3], children: Vec<usize>) -> Value {
    let info = &description.info;
    // The sine and the cosine of 45 degrees, half of a quarter turn.
    let sine = std::f64::consts::FRAC_1_SQRT_2;
    let rotation = match info.up.as_str() {
        "z" => [-sine, 0.0, 0.0, sine],
        "x" => [0.0, 0.0, sine, sine],
        _ => [0.0, 0.0, 0.0, 1.0],
    };
    let scale = [info.unit; 3];
    let mut node = json!({ "name": info.scene, "children": children, "rotation": rotation, "scale": scale });
    if offset != [0.0; 3] {
        let turned = DQuat::from_array(rotation) * (DVec3::from_array(offset) * info.unit);
        node["translation"] = json!(turned.to_array());
    }
    node
}

fn material(material: &Material) -> Value {
    // The roughness whose reflection is as wide as that of the Phong exponent.
    let roughness = (2.0 / (f64::from(material.shininess) + 2.0)).sqrt();
    let [red, green, blue] = material.diffuse;
    let mut surface = json!({
        "baseColorFactor": [red, green, blue, material.alpha], "metallicFactor": 0.0, "roughnessFactor": roughness,
    });
    if let Some(texture) = material.color_texture {
        surface["baseColorTexture"] = json!({ "index": texture });
    }
    let mut value = json!({
        "name": material.name, "pbrMetallicRoughness": surface, "doubleSided": material.double_sided,
    });
    if let Some(texture) = material.normal_texture {
        value["normalTexture"] = json!({ "index": texture });
    }
    match material.alpha_mode {
        AlphaMode::Mask => {
            value["alphaMode"] = json!("MASK");
            value["alphaCutoff"] = json!(material.alpha_cutoff);
        }
        AlphaMode::Blend => value["alphaMode"] = json!("BLEND"),
        AlphaMode::Opaque | AlphaMode::Unspecified => {}
    }
    value
}

/// Adds a texture as PNG.
fn image(glb: &mut GlbBuilder<'_>, texture: &Texture) -> Result<Value> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, texture.width, texture.height);
    encoder.set_color(png::ColorType::Rgba);
    encoder.set_depth(png::BitDepth::Eight);
    let written = encoder.write_header().and_then(|mut writer| writer.write_image_data(&texture.pixels));
    written.map_err(|error| Error::invalid(format!("texture '{}'", texture.name), "RGBA pixels", error))?;
    Ok(json!({ "name": texture.name, "mimeType": "image/png", "bufferView": glb.add_view(&bytes)? }))
}

/// The accessors of a shape.
#[derive(Clone)]
struct ShapeAccessors {
    attributes: Value,
    /// The view of the indices.
    indices: usize,
    /// One per mode.
    targets: Vec<Value>,
}

#[derive(Default)]
struct Meshes {
    /// By the index of the shape.
    shapes: HashMap<usize, ShapeAccessors>,
    /// Index of the mesh for a shape and its ranges of materials, each as first triangle and material.
    mesh_indices: HashMap<(usize, Vec<(usize, usize)>), usize>,
    meshes: Vec<Value>,
}

impl Meshes {
    fn mesh_of(&mut self, glb: &mut GlbBuilder<'_>, description: &SceneDescription, domain: &Domain) -> Result<usize> {
        let whole = [MaterialRange { first_triangle: 0, material: domain.material }];
        let ranges = if domain.material_ranges.is_empty() { &whole[..] } else { &domain.material_ranges };
        let key = (domain.shape, ranges.iter().map(|range| (range.first_triangle, range.material)).collect::<Vec<_>>());
        if let Some(mesh) = self.mesh_indices.get(&key) {
            return Ok(*mesh);
        }
        let shape = &description.shapes[domain.shape];
        let accessors = match self.shapes.get(&domain.shape) {
            Some(accessors) => accessors.clone(),
            None => self.shapes.entry(domain.shape).or_insert(add_shape(glb, shape)?).clone(),
        };
        let ends = ranges.iter().skip(1).map(|range| range.first_triangle).chain([shape.triangle_count]);
        let mut primitives = Vec::new();
        for (range, end) in ranges.iter().zip(ends) {
            let count = end.min(shape.triangle_count).saturating_sub(range.first_triangle);
            if count > 0 {
                let indices = glb.add_indices(accessors.indices, 3 * range.first_triangle, 3 * count);
                let mut primitive = json!({
                    "attributes": accessors.attributes, "indices": indices, "material": range.material,
                });
                if !accessors.targets.is_empty() {
                    primitive["targets"] = accessors.targets.clone().into();
                }
                primitives.push(primitive);
            }
        }
        let mut mesh = json!({ "name": domain.name, "primitives": primitives });
        if shape.rank > 0 {
            let names: Vec<String> = (0..shape.rank).map(|mode| format!("q{mode}")).collect();
            mesh["weights"] = vec![0.0; shape.rank].into();
            mesh["extras"] = json!({ "targetNames": names });
        }
        self.meshes.push(mesh);
        self.mesh_indices.insert(key, self.meshes.len() - 1);
        Ok(self.meshes.len() - 1)
    }
}

/// Adds the arrays of a shape: a vertex of glTF is a corner.
fn add_shape(glb: &mut GlbBuilder<'_>, shape: &Shape) -> Result<ShapeAccessors> {
    // Three numbers per corner, from three numbers per vertex.
    let of_corners = |vector: &dyn Fn(usize) -> [f32; 3]| -> Vec<f32> {
        shape.corner_vertices.iter().flat_map(|vertex| vector(*vertex as usize)).collect()
    };
    let position = |vertex: usize| std::array::from_fn(|axis| shape.local_positions()[3 * vertex + axis]);
    let mut attributes = json!({
        "POSITION": glb.add_floats(Element::Vec3, &of_corners(&position))?,
        "NORMAL": glb.add_floats(Element::Vec3, &shape.rest_normals)?,
    });
    if !shape.uvs.is_empty() {
        attributes["TEXCOORD_0"] = glb.add_floats(Element::Vec2, &shape.uvs)?.into();
    }
    let mut targets = Vec::new();
    for mode in 0..shape.rank {
        let entries = |vertex: usize| std::array::from_fn(|axis| shape.modes[(3 * vertex + axis) * shape.rank + mode]);
        targets.push(json!({ "POSITION": glb.add_floats(Element::Vec3, &of_corners(&entries))? }));
    }
    let indices = glb.add_view(bytemuck::cast_slice(&shape.indices))?;
    Ok(ShapeAccessors { attributes, indices, targets })
}

/// A transform in the form of a glTF node.
#[derive(Debug, Clone, Copy, PartialEq)]
struct NodeTransform {
    translation: [f32; 3],
    /// Quaternion x y z w.
    rotation: [f32; 4],
    scale: [f32; 3],
}

impl NodeTransform {
    /// Decomposes a transform; `None` if it has shear or maps to a plane. The rotation has the sign that is nearer to
    /// `previous`, so that interpolation takes the shorter way.
    fn decompose(matrix: &Matrix3x4, previous: Option<&Self>) -> Option<Self> {
        let column = |column: usize| DVec3::new(matrix[column], matrix[4 + column], matrix[8 + column]);
        let axes = [column(0), column(1), column(2)];
        let mut scale = axes.map(DVec3::length);
        if scale.iter().any(|length| *length <= f64::MIN_POSITIVE || !length.is_finite()) {
            return None;
        }
        let mut units: [DVec3; 3] = std::array::from_fn(|axis| axes[axis] / scale[axis]);
        let has_shear = [(0, 1), (1, 2), (2, 0)].iter().any(|(a, b)| units[*a].dot(units[*b]).abs() > SHEAR_TOLERANCE);
        if has_shear {
            return None;
        }
        if DMat3::from_cols(units[0], units[1], units[2]).determinant() < 0.0 {
            (units[0], scale[0]) = (-units[0], -scale[0]);
        }
        let rotation = DQuat::from_mat3(&DMat3::from_cols(units[0], units[1], units[2])).normalize();
        let rotation = rotation.as_quat().to_array();
        let dot = previous.map_or(0.0, |previous| rotation.iter().zip(previous.rotation).map(|(a, b)| a * b).sum());
        let rotation = if dot < 0.0 { rotation.map(|entry: f32| -entry) } else { rotation };
        let translation = column(3).as_vec3().to_array();
        Some(Self { translation, rotation, scale: scale.map(|length| length as f32) })
    }
}

/// The mesh of a domain, and the point of the domain's frame that the positions of the mesh are relative to.
#[derive(Debug, Clone, Copy)]
struct DomainPlace {
    mesh: usize,
    origin: [f64; 3],
}

struct Animation {
    /// The accessor of the times.
    input: usize,
    /// The point that translations are relative to.
    offset: [f64; 3],
    samplers: Vec<Value>,
    channels: Vec<Value>,
}

impl Animation {
    /// Adds the channels of a domain, and returns its node. The node has the values of the first state.
    fn add_domain(
        &mut self,
        glb: &mut GlbBuilder<'_>,
        domain: &Domain,
        DomainPlace { mesh, origin }: DomainPlace,
        track: &Track,
        selected: &StateTimes,
    ) -> Result<Value> {
        let mut transforms: Vec<NodeTransform> = Vec::with_capacity(track.transforms.len());
        for (matrix, step) in track.transforms.iter().zip(&selected.steps) {
            let (mut matrix, translation) = (*matrix, apply(matrix, origin));
            (0..3).for_each(|axis| matrix[4 * axis + 3] = translation[axis] - self.offset[axis]);
            let transform = NodeTransform::decompose(&matrix, transforms.last());
            transforms.push(transform.ok_or_else(|| {
                let field = format!("step {step}: transform of domain '{}'", domain.name);
                Error::invalid(
                    field,
                    "translation, rotation and scale, the only transforms of glTF",
                    "shear or a scale of 0",
                )
            })?);
        }
        let numbers = |vectors: Vec<Vec<f32>>| vectors.concat();
        let node = domain.index;
        let translations = numbers(transforms.iter().map(|transform| transform.translation.to_vec()).collect());
        self.add_channel(glb, node, "translation", Element::Vec3, &translations)?;
        let rotations = numbers(transforms.iter().map(|transform| transform.rotation.to_vec()).collect());
        self.add_channel(glb, node, "rotation", Element::Vec4, &rotations)?;
        let scales = numbers(transforms.iter().map(|transform| transform.scale.to_vec()).collect());
        self.add_channel(glb, node, "scale", Element::Vec3, &scales)?;
        let mut value = json!({ "name": domain.name, "mesh": mesh });
        if let Some(first) = transforms.first() {
            value["translation"] = json!(first.translation);
            value["rotation"] = json!(first.rotation);
            value["scale"] = json!(first.scale);
        }
        if domain.rank > 0 {
            self.add_weights(glb, domain, &track.q)?;
            value["weights"] = json!(track.q.get(..domain.rank).unwrap_or_default());
        }
        Ok(value)
    }

    fn add_weights(&mut self, glb: &mut GlbBuilder<'_>, domain: &Domain, q: &[f32]) -> Result<()> {
        let is_constant = q.chunks(domain.rank).all(|state| state == &q[..domain.rank]);
        if is_constant {
            return Ok(());
        }
        let output = glb.add_floats(Element::Scalar, q)?;
        self.push(domain.index, "weights", output);
        Ok(())
    }

    /// Adds a channel unless the values are the same in all states.
    fn add_channel(
        &mut self,
        glb: &mut GlbBuilder<'_>,
        node: usize,
        path: &str,
        element: Element,
        numbers: &[f32],
    ) -> Result<()> {
        let size = if element == Element::Vec4 { 4 } else { 3 };
        if numbers.chunks(size).all(|value| value == &numbers[..size]) {
            return Ok(());
        }
        let output = glb.add_floats(element, numbers)?;
        self.push(node, path, output);
        Ok(())
    }

    fn push(&mut self, node: usize, path: &str, output: usize) {
        let sampler = self.samplers.len();
        self.samplers.push(json!({ "input": self.input, "output": output, "interpolation": "LINEAR" }));
        self.channels.push(json!({ "sampler": sampler, "target": { "node": node, "path": path } }));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn transforms_without_shear_are_decomposed_and_others_rejected() {
        // A rotation by 90 degrees about z, with scales 2, 3 and -4.
        let matrix = [0.0, -3.0, 0.0, 5.0, 2.0, 0.0, 0.0, 6.0, 0.0, 0.0, -4.0, 7.0];
        let node = NodeTransform::decompose(&matrix, None).expect("no shear");
        let rotation = glam::Quat::from_array(node.rotation);
        let scale = glam::Vec3::from_array(node.scale);
        for (axis, expected) in [[0.0, 2.0, 0.0], [-3.0, 0.0, 0.0], [0.0, 0.0, -4.0]].into_iter().enumerate() {
            let mut unit = glam::Vec3::ZERO;
            unit[axis] = 1.0;
            let mapped = rotation * (scale * unit);
            assert!(mapped.distance(expected.into()) < 1e-5, "axis {axis}: {mapped}");
        }
        assert_eq!(node.translation, [5.0, 6.0, 7.0]);
        let sheared = [1.0, 0.1, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
        assert_eq!(NodeTransform::decompose(&sheared, None), None);
        let flat = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        assert_eq!(NodeTransform::decompose(&flat, None), None);
    }

    #[test]
    fn rotation_has_the_sign_of_the_previous_one() {
        let turned = |degrees: f64| {
            let (sine, cosine) = degrees.to_radians().sin_cos();
            [cosine, -sine, 0.0, 0.0, sine, cosine, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]
        };
        let mut previous = None;
        for step in 0..72 {
            let next = NodeTransform::decompose(&turned(f64::from(step) * 10.0), previous.as_ref()).expect("no shear");
            if let Some(previous) = previous {
                let dot: f32 = next.rotation.iter().zip(previous.rotation).map(|(a, b)| a * b).sum();
                assert!(dot > 0.99, "step {step}: {dot}");
            }
            previous = Some(next);
        }
    }
}
