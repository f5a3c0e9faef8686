//! Reads the surface of a part from a model file, with the loaders of the server.

use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io::Read as _;
use std::path::Path;

use modalcast_model::domain::Material;
use modalcast_model::error::{Result, invalid};
use modalcast_model::load::{self, LoadOptions};
use modalcast_model::scene::Scene;
use nalgebra::Vector3;
use sha2::{Digest as _, Sha256};

use crate::disjoint_sets::DisjointSets;

/// The mesh that is drawn, with the vertices and normals of the file. Positions are in meters, in the axes of the file.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct DrawnMesh {
    pub positions: Vec<Vector3<f64>>,
    pub triangles: Vec<[u32; 3]>,
    pub corner_normals: Vec<[[f32; 3]; 3]>,
    /// The index of the group of each triangle.
    pub triangle_groups: Vec<u32>,
    /// The index of the color of each triangle.
    pub triangle_materials: Vec<u32>,
    /// sRGB with alpha, 0 to 1. Empty if the file has no colors.
    pub material_colors: Vec<[f32; 4]>,
}

/// A surface file.
#[derive(Debug, Clone, Default)]
pub struct SurfaceFile {
    /// The file name without its folder.
    pub name: String,
    /// SHA-256 of the file, hexadecimal.
    pub sha256: String,
    /// The axis of the file that points up: 0 for x, 1 for y, 2 for z.
    pub up_axis: usize,
    pub mesh: DrawnMesh,
    /// Names of the groups: materials or objects of the file. A file with one group and several shells has the groups
    /// `shell 1`, `shell 2` and so on, those with more triangles first.
    pub groups: Vec<String>,
    /// The remarks of the loader.
    pub remarks: Vec<String>,
}

/// Reads a model file.
///
/// # Errors
/// Those of the loaders; `Invalid` for scenes that are not a file.
pub fn read(path: &str, options: &LoadOptions) -> Result<SurfaceFile> {
    let file_path = Path::new(path);
    if !file_path.is_file() {
        return Err(invalid(format!("file '{path}'"), "an existing model file", "none of this name"));
    }
    let opened = load::open_without_modes(path, options)?;
    let mut file = SurfaceFile {
        name: file_path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default(),
        sha256: hash_file(file_path).map_err(|error| invalid(format!("file '{path}'"), "a readable file", error))?,
        up_axis: opened.up.index(),
        remarks: opened.remarks.clone(),
        ..SurfaceFile::default()
    };
    for domain in 0..opened.domains.len() {
        add_domain(&opened, domain, opened.unit, &mut file);
    }
    if file.groups.len() == 1 {
        name_shells(&mut file);
    }
    if opened.materials.iter().any(|material| material.diffuse != Material::UNSPECIFIED_COLOR) {
        let to_srgb = |linear: f32| match linear {
            ..=0.003_130_8 => 12.92 * linear,
            _ => 1.055 * linear.powf(1.0 / 2.4) - 0.055,
        };
        let color = |material: &Material| {
            let [red, green, blue] = material.diffuse.map(to_srgb);
            [red, green, blue, material.alpha]
        };
        file.mesh.material_colors = opened.materials.iter().map(color).collect();
    }
    let is_finite = file.mesh.positions.iter().all(|position| position.iter().all(|coordinate| coordinate.is_finite()));
    match is_finite {
        true => Ok(file),
        false => Err(invalid(format!("file '{path}'"), "finite positions", "an infinite one")),
    }
}

/// The SHA-256 of a file, hexadecimal.
pub(crate) fn hash_file(path: &Path) -> std::io::Result<String> {
    let (mut file, mut hash, mut buffer) = (File::open(path)?, Sha256::new(), vec![0; 1 << 16]);
    loop {
        match file.read(&mut buffer)? {
            0 => return Ok(hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()),
            count => hash.update(&buffer[..count]),
        }
    }
}

/// Adds a domain with its placement at rest. Each of its materials is a group.
fn add_domain(scene: &Scene, domain: usize, unit: f64, file: &mut SurfaceFile) {
    let shape = scene.shape_of(domain);
    let domain = &scene.domains[domain];
    let placement = domain.placement_matrix();
    let mesh = &mut file.mesh;
    let first_vertex = mesh.positions.len() as u32;
    let place = |position: [f64; 3]| placement.transform_point(&position.into()).coords * unit;
    mesh.positions.extend(shape.exact_positions().map(place));
    let normal_matrix = placement.fixed_view::<3, 3>(0, 0).try_inverse().unwrap_or_default().transpose();
    let corners = shape.mesh.corners();
    let rotate = |normal: [f32; 3]| {
        let rotated = normal_matrix * Vector3::from(normal).cast::<f64>();
        rotated.try_normalize(0.0).map_or(normal, |normal| normal.cast::<f32>().into())
    };
    let mut group_of_material = HashMap::new();
    for (index, triangle) in shape.mesh.triangles().iter().enumerate() {
        mesh.triangles.push(triangle.map(|corner| first_vertex + corners.vertices[corner as usize]));
        mesh.corner_normals.push(triangle.map(|corner| rotate(corners.normals[corner as usize])));
        let ranges_before = domain.material_ranges.partition_point(|range| range.first_triangle <= index);
        let range = ranges_before.checked_sub(1).map(|range| &domain.material_ranges[range]);
        let material = range.map_or(domain.material, |range| range.material);
        mesh.triangle_materials.push(material as u32);
        let group = *group_of_material.entry(material).or_insert_with(|| {
            let name = match domain.material_ranges.len() {
                0 | 1 if scene.domains.len() > 1 => &domain.name,
                _ => &scene.materials[material].name,
            };
            let known = file.groups.iter().position(|group| group == name);
            known.unwrap_or_else(|| {
                file.groups.push(name.clone());
                file.groups.len() - 1
            }) as u32
        });
        mesh.triangle_groups.push(group);
    }
}

/// Makes each shell, a set of triangles that are connected by vertices, a group. A surface with more than
/// [`MAX_SHELLS`] shells keeps its group: most of them are then loose triangles.
fn name_shells(file: &mut SurfaceFile) {
    const MAX_SHELLS: usize = 32;
    let mesh = &mut file.mesh;
    let mut first_at = HashMap::new();
    let mut sets = DisjointSets::new(mesh.positions.len());
    for (vertex, position) in mesh.positions.iter().enumerate() {
        let key: [u64; 3] = [0, 1, 2].map(|axis| (position[axis] + 0.0).to_bits());
        sets.merge(vertex, *first_at.entry(key).or_insert(vertex));
    }
    for [a, b, c] in &mesh.triangles {
        sets.merge(*a as usize, *b as usize);
        sets.merge(*b as usize, *c as usize);
    }
    let shells: Vec<usize> = mesh.triangles.iter().map(|[vertex, ..]| sets.find(*vertex as usize)).collect();
    let mut sizes: BTreeMap<usize, usize> = BTreeMap::new();
    for shell in &shells {
        *sizes.entry(*shell).or_default() += 1;
    }
    if !(2..=MAX_SHELLS).contains(&sizes.len()) {
        return;
    }
    let mut order: Vec<usize> = sizes.keys().copied().collect();
    order.sort_by_key(|shell| std::cmp::Reverse(sizes[shell]));
    let number_of: HashMap<usize, u32> = order.into_iter().zip(0..).collect();
    file.groups = (1..=sizes.len()).map(|number| format!("shell {number}")).collect();
    mesh.triangle_groups = shells.iter().map(|shell| number_of[shell]).collect();
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn materials_of_an_obj_file_are_groups() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("part.obj");
        std::fs::write(folder.path().join("part.mtl"), "newmtl red\nKd 1 0 0\nnewmtl blue\nKd 0 0 1\n")
            .expect("a file");
        let text = "mtllib part.mtl\nv 0 0 0\nv 10 0 0\nv 0 10 0\nv 0 0 10\n\
                    usemtl red\nf 1 3 2\nf 1 2 4\nusemtl blue\nf 1 4 3\nf 2 3 4\n";
        std::fs::write(&path, text).expect("a file");
        let options = LoadOptions { unit: Some("mm".parse().expect("a unit")), ..LoadOptions::default() };
        let file = read(&path.to_string_lossy(), &options).expect("a surface");
        assert_eq!(file.groups, ["red", "blue"]);
        assert_eq!(file.mesh.triangle_groups, [0, 0, 1, 1]);
        assert!((file.mesh.positions[1] - Vector3::new(0.01, 0.0, 0.0)).norm() < 1e-9);
        assert_eq!((file.up_axis, file.name.as_str()), (1, "part.obj"));
        let [red, green, ..] = file.mesh.material_colors[0];
        assert!((red - 1.0).abs() < 1e-6 && green == 0.0);
    }

    /// Two tetrahedra without names, the second one with more triangles.
    #[test]
    fn shells_without_names_are_groups() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("two.obj");
        let mut text = String::new();
        for x in [0, 5] {
            for [dx, y, z] in [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1]] {
                text.push_str(&format!("v {} {y} {z}\n", x + dx));
            }
        }
        text.push_str("f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n");
        text.push_str("f 6 7 9\nf 6 9 8\nf 7 8 9\nf 6 10 7\nf 6 8 10\nf 7 10 8\n");
        std::fs::write(&path, text).expect("a file");
        let file = read(&path.to_string_lossy(), &LoadOptions::default()).expect("a surface");
        assert_eq!(file.groups, ["shell 1", "shell 2"]);
        assert_eq!(file.mesh.triangle_groups, [1, 1, 1, 1, 0, 0, 0, 0, 0, 0]);
    }

    #[test]
    fn missing_file_is_an_error() {
        let error = read("missing.stl", &LoadOptions::default()).expect_err("expected an error").to_string();
        assert!(error.contains("missing.stl"), "{error}");
    }
}
