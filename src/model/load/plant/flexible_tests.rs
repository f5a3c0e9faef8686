//! Tests of plants whose shoots have radii.

use std::fmt::Write as _;

use nalgebra::{Rotation3, Vector3};

use super::*;

/// A plant under construction: an OBJ file, the object of each face, and the structure.
#[derive(Default)]
struct PlantFiles {
    obj: String,
    vertex_count: usize,
    ids: String,
    objects: Vec<String>,
    shoots: Vec<String>,
    leaves: Vec<String>,
}

impl PlantFiles {
    /// Adds an object and returns its id.
    fn add_object(&mut self, kind: &str, points: &[Vector3<f64>], faces: &[[usize; 3]]) -> usize {
        let id = self.objects.len() + 1;
        self.objects.push(format!(r#""{id}": "{kind}""#));
        points.iter().for_each(|point| writeln!(self.obj, "v {} {} {}", point.x, point.y, point.z).expect("a text"));
        for face in faces {
            let [a, b, c] = face.map(|vertex| vertex + self.vertex_count + 1);
            writeln!(self.obj, "f {a} {b} {c}").expect("a text");
            writeln!(self.ids, "{id}").expect("a text");
        }
        self.vertex_count += points.len();
        id
    }

    /// Adds a tube of six sides.
    fn add_tube(&mut self, kind: &str, polyline: &[Vector3<f64>], radius: f64) -> usize {
        let ring = |center: &Vector3<f64>| {
            let center = *center;
            let axis = (polyline[polyline.len() - 1] - polyline[0]).normalize();
            let x = axis.cross(&Vector3::new(0.3, 0.5, 0.1)).normalize();
            let y = axis.cross(&x);
            (0..6).map(move |side| {
                let angle = std::f64::consts::TAU * f64::from(side) / 6.0;
                center + (x * angle.cos() + y * angle.sin()) * radius
            })
        };
        let points: Vec<_> = polyline.iter().flat_map(ring).collect();
        let mut faces = Vec::new();
        for (row, side) in (0..polyline.len() - 1).flat_map(|row| (0..6).map(move |side| (row, side))) {
            let corner = |row: usize, side: usize| 6 * row + side % 6;
            faces.push([corner(row, side), corner(row, side + 1), corner(row + 1, side + 1)]);
            faces.push([corner(row, side), corner(row + 1, side + 1), corner(row + 1, side)]);
        }
        self.add_object(kind, &points, &faces)
    }

    /// Adds a shoot. `radii` is the text of its radii.
    fn add_shoot(&mut self, parent: i64, polyline: &[Vector3<f64>], radii: &str) {
        let id = self.shoots.len();
        let vertices: Vec<_> =
            polyline.iter().map(|point| format!("[{}, {}, {}]", point.x, point.y, point.z)).collect();
        let vertices = vertices.join(",");
        self.shoots.push(format!(r#"{{"id": {id}, "parent": {parent}, "vertices": [{vertices}]{radii}}}"#));
    }

    /// Adds a leaf: a petiole of 4 cm along the direction x of `rotation`, then a blade of 10 cm, both scaled.
    fn add_leaf(&mut self, shoot: usize, origin: &Vector3<f64>, rotation: &Rotation3<f64>, scale: f64) {
        let place = |x: f64, y: f64, z: f64| origin + rotation * Vector3::new(x, y, z) * scale;
        let petiole = [place(0.0, 0.0, 0.0), place(0.04, 0.0, 0.0)];
        self.add_tube("petiole", &petiole, 5e-4 * scale);
        let blade = [
            place(0.04, -0.02, 0.0),
            place(0.04, 0.02, 0.0),
            place(0.09, -0.02, -0.01),
            place(0.09, 0.02, -0.01),
            place(0.13, 0.0, -0.03),
        ];
        let id = self.add_object("leaf", &blade, &[[0, 2, 3], [0, 3, 1], [2, 4, 3]]);
        let point = |point: Vector3<f64>| format!("[{}, {}, {}]", point.x, point.y, point.z);
        let (base, node) = (point(petiole[1]), self.leaves.len());
        self.leaves.push(format!(
            r#"{{"object_id": {id}, "shoot": {shoot}, "node": {node}, "petiole": 0, "base": {base},
                "petiole_vertices": [{}, {base}]}}"#,
            point(petiole[0])
        ));
    }

    fn read(&self, options: ModelOptions) -> Result<SceneParts> {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let json = format!(
            r#"{{"objects": {{{}}}, "shoots": [{}], "leaves": [{}]}}"#,
            self.objects.join(","),
            self.shoots.join(","),
            self.leaves.join(",")
        );
        for (name, text) in [("p.obj", &self.obj), ("p_object_id.dat", &self.ids), ("p.structure.json", &json)] {
            std::fs::write(folder.path().join(name), text).expect("a writable file");
        }
        read(&AssetDir::unrestricted(folder.path()), "p.obj", options)
    }
}

/// A trunk of 1 m that carries a stub at its middle and three leaves. The stub carries a fruit.
fn plant(trunk_radii: &str) -> PlantFiles {
    let mut files = PlantFiles::default();
    let trunk: Vec<_> =
        (0..11).map(|index| Vector3::new(0.01 * f64::from(index % 2), 0.0, 0.1 * f64::from(index))).collect();
    let stub: Vec<_> = (0..4).map(|index| trunk[5] + Vector3::new(0.01, 0.007 * f64::from(index), 0.0)).collect();
    files.add_tube("internode", &trunk, 0.01);
    files.add_tube("internode", &stub, 0.002);
    files.add_shoot(-1, &trunk, trunk_radii);
    files.add_shoot(0, &stub, r#", "radii": [0.002, 0.002, 0.002, 0.002]"#);
    let tip = stub[3];
    let octahedron: Vec<_> = [Vector3::x(), Vector3::y(), Vector3::z()]
        .iter()
        .flat_map(|axis| [tip + axis * 0.01, tip - axis * 0.01])
        .collect();
    let faces = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]];
    files.add_object("fruit", &octahedron, &faces);
    for (index, scale) in [1.0, 0.5, 1.0].into_iter().enumerate() {
        let rotation = Rotation3::from_euler_angles(0.4 * index as f64, 0.3, 1.1 * index as f64);
        files.add_leaf(0, &trunk[7 + index], &rotation, scale);
    }
    files
}

const TRUNK_RADII: &str = r#", "radii": [0.01, 0.01, 0.01, 0.01, 0.01, 0.01, 0.01, 0.01, 0.01, 0.01, 0.01]"#;

fn read_plant(files: &PlantFiles) -> SceneParts {
    files.read(ModelOptions::default()).expect("a valid plant")
}

fn ranks(parts: &SceneParts) -> Vec<usize> {
    parts.domains.iter().map(|domain| parts.shapes[domain.shape].modes.rank()).collect()
}

#[test]
fn shoots_and_leaves_have_modes_and_attachments() {
    let parts = read_plant(&plant(TRUNK_RADII));
    assert_eq!(ranks(&parts), [12, 6, 3, 3, 3], "{:?}", parts.remarks);
    for (index, domain) in parts.domains.iter().enumerate() {
        let metadata = &domain.metadata;
        assert!(metadata.eigenvalues.iter().all(|eigenvalue| *eigenvalue > 0.0 && eigenvalue.is_finite()));
        assert_eq!(metadata.eigenvalues.len(), ranks(&parts)[index]);
        assert_eq!(metadata.inertia.as_ref().expect("an inertia").rank(), ranks(&parts)[index]);
        assert_eq!(metadata.notes["mass_normalized"], "true");
        let Some(attachment) = &domain.attachment else { continue };
        // A ring of the trunk has six vertices, and its center is the joint or beside it.
        assert_eq!(attachment.vertices.len(), 6, "{}", domain.name);
        let rest_positions = parts.shapes[attachment.parent].mesh.rest_positions();
        let place = |vertex: &u32| Vector3::from(rest_positions[*vertex as usize]).cast::<f64>();
        let center = attachment.vertices.iter().map(place).sum::<Vector3<f64>>() / 6.0;
        let distance = (center - attachment.frame.translation()).norm();
        let expected = if index == 1 { 0.01 } else { 0.0 };
        assert!((distance - expected).abs() < 1e-3, "{}: {distance}", domain.name);
    }
    crate::scene::Scene::new(parts).expect("a valid scene");
}

#[test]
fn masses_add_up_and_fruits_belong_to_their_shoot() {
    let parts = read_plant(&plant(TRUNK_RADII));
    let mass = |index: usize| parts.domains[index].metadata.inertia.as_ref().expect("an inertia").mass();
    let trunk: f64 = 900.0 * std::f64::consts::PI * 1e-4 * 10.0 * (0.01_f64.powi(2) + 0.01).sqrt();
    assert!((mass(0) / trunk - 1.0).abs() < 1e-6, "{} {trunk}", mass(0));
    let stub = 900.0 * std::f64::consts::PI * 4e-6 * 0.021;
    // The volume of an octahedron with half-diagonals a is 4/3 a^3.
    let fruit = 900.0 * 4.0 / 3.0 * 1e-6;
    assert!((mass(1) / (stub + fruit) - 1.0).abs() < 1e-6, "{}", mass(1));
    let carried: f64 = parts.domains[0].metadata.notes["carried_mass"].parse().expect("a number");
    let expected = mass(1) + mass(2) + mass(3) + mass(4);
    assert!((carried / expected - 1.0).abs() < 2e-3, "{carried} {expected}");
    // The fruit moves rigidly with the end of the stub.
    let shape = &parts.shapes[1];
    let first = shape.mesh.rest_positions().len() - 6;
    for mode in 0..6 {
        let displacement = |vertex: usize| Vector3::from_fn(|axis, _| f64::from(shape.modes.entry(vertex, axis, mode)));
        let place = |vertex: usize| Vector3::from(shape.mesh.rest_positions()[vertex]).cast::<f64>();
        let scale = displacement(first).norm();
        for pair in [(0, 1), (0, 2), (3, 5)] {
            let axis = (place(first + pair.0) - place(first + pair.1)).normalize();
            let strain = (displacement(first + pair.0) - displacement(first + pair.1)).dot(&axis);
            assert!(strain.abs() < 1e-5 * scale, "mode {mode}: {strain} {scale}");
        }
    }
}

#[test]
fn scaled_copies_of_a_leaf_have_scaled_modes() {
    let parts = read_plant(&plant(TRUNK_RADII));
    let eigenvalues = |index: usize| &parts.domains[index].metadata.eigenvalues;
    let amplitude = |index: usize, mode: usize| {
        let modes = &parts.shapes[index].modes;
        let squares = modes.column(mode).iter().map(|entry| f64::from(*entry).powi(2));
        squares.sum::<f64>().sqrt()
    };
    for mode in 0..3 {
        assert!((eigenvalues(3)[mode] / eigenvalues(2)[mode] / 4.0 - 1.0).abs() < 1e-6, "expected 1 / s^2");
        assert!((eigenvalues(4)[mode] / eigenvalues(2)[mode] - 1.0).abs() < 1e-6);
        assert!((amplitude(3, mode) / amplitude(2, mode) / 0.5_f64.powf(-1.5) - 1.0).abs() < 1e-3, "expected s^-1.5");
        assert!((amplitude(4, mode) / amplitude(2, mode) - 1.0).abs() < 1e-3);
    }
    // U^T M U of a leaf that carries nothing is I, also for copies.
    for index in 2..5 {
        let matrix = parts.domains[index].metadata.inertia.as_ref().expect("an inertia").mass_matrix();
        let gram = matrix.view((6, 6), (3, 3)).into_owned() - nalgebra::DMatrix::<f64>::identity(3, 3);
        assert!(gram.amax() < 1e-6, "{gram}");
    }
}

#[test]
fn organs_without_valid_radii_are_rigid_with_a_remark() {
    let zeros = r#", "radii": [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]"#;
    for (radii, reason) in [("", "it has no radii"), (zeros, "profile: expected positive finite sections")] {
        let parts = read_plant(&plant(radii));
        assert_eq!(ranks(&parts), [0, 6, 3, 3, 3], "{radii}");
        assert!(
            parts
                .remarks
                .iter()
                .any(|remark| remark.starts_with(&format!("1 of 5 organs are rigid: shoot 0 ({reason}"))),
            "{:?}",
            parts.remarks
        );
        // A rigid parent has no attachment vertices.
        assert!(parts.domains[1].attachment.as_ref().expect("a parent").vertices.is_empty());
    }
}

#[test]
fn plants_without_any_radii_or_with_modes_turned_off_are_rigid() {
    let mut files = plant("");
    files.shoots[1] = files.shoots[1].replace("radii", "diameters");
    let parts = read_plant(&files);
    assert_eq!(ranks(&parts), [0; 5]);
    assert_eq!(parts.remarks, ["the structure has no radii: all organs are rigid"]);
    let options = ModelOptions { modes: ModesSource::None, ..ModelOptions::default() };
    assert_eq!(ranks(&plant(TRUNK_RADII).read(options).expect("a valid plant")), [0; 5]);
}

#[test]
fn degenerate_shoots_do_not_panic() {
    // A shoot of one point, one of repeated points, a needle, and a disk.
    for (polyline, radii, is_rigid) in [
        (vec![[0.0, 0.0, 0.0]], "[0.01]", true),
        (vec![[0.0, 0.0, 0.0]; 3], "[0.01, 0.01, 0.01]", true),
        (vec![[0.0, 0.0, 0.0], [0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 1.0]], "[0.01, 0.01, 0.02, 0.02]", false),
        (vec![[0.0, 0.0, 0.0], [0.0, 0.0, 100.0]], "[1e-4, 1e-4]", false),
        (vec![[0.0, 0.0, 0.0], [0.0, 0.0, 1e-3]], "[1, 1]", false),
    ] {
        let mut files = PlantFiles::default();
        let polyline: Vec<Vector3<f64>> = polyline.into_iter().map(Vector3::from).collect();
        files.add_tube("internode", &[Vector3::zeros(), Vector3::z()], 0.01);
        files.add_shoot(-1, &polyline, &format!(r#", "radii": {radii}"#));
        files.add_leaf(0, &polyline[polyline.len() - 1], &Rotation3::identity(), 1.0);
        let parts = read_plant(&files);
        assert_eq!(ranks(&parts)[0] == 0, is_rigid, "{polyline:?}: {:?}", parts.remarks);
        assert_eq!(ranks(&parts)[1], 3);
        crate::scene::Scene::new(parts).expect("a valid scene");
    }
}

#[test]
fn shoot_with_too_many_points_is_rigid() {
    let mut files = PlantFiles::default();
    files.add_tube("internode", &[Vector3::zeros(), Vector3::z()], 0.01);
    let polyline: Vec<_> = (0..5000).map(|index| Vector3::new(0.0, 0.0, 1e-3 * f64::from(index))).collect();
    let radii = vec!["0.01"; polyline.len()].join(",");
    files.add_shoot(-1, &polyline, &format!(r#", "radii": [{radii}]"#));
    let parts = read_plant(&files);
    assert_eq!(ranks(&parts), [0]);
    assert!(parts.remarks.iter().any(|remark| remark.contains("at most 4096 points")), "{:?}", parts.remarks);
}

#[test]
fn stiffer_wood_has_higher_frequencies() {
    let lowest = |factor: f64| {
        let text = format!("wood_youngs_modulus = {}\n wood_shear_modulus = {}\n", factor * 1e10, factor * 6.25e8);
        let materials: PlantMaterials = toml::from_str(&text).expect("valid constants");
        materials.check().expect("valid constants");
        let options = ModelOptions { plant: materials, ..ModelOptions::default() };
        plant(TRUNK_RADII).read(options).expect("a valid plant").domains[0].metadata.eigenvalues[0]
    };
    assert!((lowest(4.0) / lowest(1.0) / 4.0 - 1.0).abs() < 1e-6);
    for text in ["wood_density = 0", "wood_density = nan", "blade_slenderness = -1"] {
        let materials: PlantMaterials = toml::from_str(text).expect("a number");
        assert!(materials.check().is_err(), "{text}");
    }
    assert!(toml::from_str::<PlantMaterials>("bark = 1").is_err());
}
