//! Solids for tests and for `modalcast report dynamics`: surfaces whose modes are known.

#![allow(dead_code, reason = "each test and the report use some of the solids")]

use modalcast_modes::materials::Material;
use modalcast_modes::surface_file::{DrawnMesh, SurfaceFile};
use modalcast_modes::{Modeling, ModelingParameters, compute_modes};
use nalgebra::{Rotation3, Unit, Vector3};

/// The first 20 frequencies of free solids in Hz, by the Rayleigh-Ritz method with polynomials of degree 18, 14, 14 and 18.
/// Two degrees less change them by at most 4e-6.
pub(crate) const BOX: [f64; 20] = [
    7.576_96, 9.163_03, 11.756_61, 14.720_34, 14.797_15, 15.252_21, 16.018_73, 16.851_24, 18.955_81, 19.663_56,
    19.682_62, 20.090_77, 22.632_49, 23.066_85, 23.212_93, 23.223_95, 23.701_63, 24.040_95, 24.420_39, 24.768_56,
];
pub(crate) const ELLIPSOID: [f64; 20] = [
    11.851_92, 13.310_75, 16.263_10, 19.570_45, 20.947_58, 20.953_63, 22.028_99, 23.346_53, 26.867_76, 27.917_67,
    28.282_01, 28.510_24, 29.770_91, 30.392_80, 30.512_95, 30.593_73, 30.956_93, 34.300_31, 35.415_11, 35.542_02,
];
pub(crate) const SPHERE: [f64; 20] = [
    15.613_50, 15.613_50, 15.613_50, 15.613_50, 15.613_50, 16.519_20, 16.519_20, 16.519_20, 16.519_20, 16.519_20,
    22.036_19, 22.036_19, 22.036_19, 24.125_66, 24.125_66, 24.125_66, 24.125_66, 24.125_66, 24.125_66, 24.125_66,
];
pub(crate) const CYLINDER: [f64; 20] = [
    9.657_77, 9.657_77, 9.805_81, 15.568_89, 17.867_59, 17.867_59, 19.611_61, 26.107_78, 26.107_78, 26.439_85,
    26.439_85, 26.559_62, 26.559_62, 26.789_81, 26.789_81, 29.045_34, 29.321_36, 29.321_36, 29.417_42, 30.408_53,
];

/// The first eight frequencies of the free plate 1 x 0.6 x 0.01 m, Hz, by the Rayleigh-Ritz method.
pub(crate) const PLATE: [f64; 8] = [0.326_49, 0.337_70, 0.764_10, 0.899_45, 0.935_00, 1.175_20, 1.378_78, 1.684_39];

/// The material of the references.
pub(crate) fn parameters(freedoms: usize, modes: usize) -> ModelingParameters {
    let material = Material::new(1e6, 0.3, 1000.0).expect("expected a material");
    ModelingParameters { modes, freedoms, material, ..ModelingParameters::default() }
}

pub(crate) fn compute(file: &SurfaceFile, parameters: &ModelingParameters) -> Modeling {
    compute_modes(file, parameters, &|_, _| {}).unwrap_or_else(|error| panic!("{error}"))
}

/// A surface of one group.
pub(crate) fn surface(positions: Vec<Vector3<f64>>, triangles: Vec<[u32; 3]>) -> SurfaceFile {
    let count = triangles.len();
    let mesh = DrawnMesh {
        positions,
        triangles,
        corner_normals: vec![[[0.0, 0.0, 1.0]; 3]; count],
        triangle_groups: vec![0; count],
        triangle_materials: vec![0; count],
        material_colors: vec![],
    };
    SurfaceFile { name: "part.stl".into(), up_axis: 2, mesh, groups: vec!["default".into()], ..SurfaceFile::default() }
}

/// A box around the origin.
pub(crate) fn solid_box(size: [f64; 3]) -> SurfaceFile {
    let corner = |index: usize| {
        Vector3::from_fn(|axis, _| if index >> axis & 1 == 1 { size[axis] / 2.0 } else { -size[axis] / 2.0 })
    };
    let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let triangles = quads.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]);
    surface((0..8).map(corner).collect(), triangles.collect())
}

/// A surface of revolution about z. `profile` gives radius and height of each ring; the first and the last ring are
/// points.
fn revolved(profile: &[[f64; 2]], sectors: usize) -> SurfaceFile {
    let position = |ring: usize, sector: usize| {
        let azimuth = std::f64::consts::TAU * (sector % sectors) as f64 / sectors as f64;
        let [radius, height] = profile[ring];
        Vector3::new(radius * azimuth.cos(), radius * azimuth.sin(), height)
    };
    let last = profile.len() - 1;
    let vertex = |ring: usize, sector: usize| match ring {
        0 => 0,
        _ if ring == last => 1,
        _ => (2 + (ring - 1) * sectors + sector % sectors) as u32,
    };
    let mut positions = vec![position(0, 0), position(last, 0)];
    positions
        .extend((1..last).flat_map(|ring| (0..sectors).map(move |sector| (ring, sector))).map(|(r, s)| position(r, s)));
    let quads = (0..last).flat_map(|ring| (0..sectors).map(move |sector| (ring, sector)));
    let triangles = quads.flat_map(|(ring, sector)| {
        let [a, b] = [vertex(ring, sector), vertex(ring + 1, sector)];
        let [c, d] = [vertex(ring + 1, sector + 1), vertex(ring, sector + 1)];
        [[a, b, c], [a, c, d]]
    });
    surface(positions, triangles.filter(|[a, b, c]| a != b && b != c && c != a).collect())
}

/// An ellipsoid with `rings` rings and twice as many sectors.
pub(crate) fn ellipsoid(semi_axes: [f64; 3], rings: usize) -> SurfaceFile {
    let ring = |index: usize| {
        let polar = std::f64::consts::PI * index as f64 / rings as f64;
        [if index == 0 || index == rings { 0.0 } else { polar.sin() }, polar.cos()]
    };
    let mut file = revolved(&(0..=rings).map(ring).collect::<Vec<_>>(), 2 * rings);
    // The inscribed polyhedron is scaled to the volume of the ellipsoid.
    let scale = (4.0 / 3.0 * std::f64::consts::PI / volume(&file)).cbrt();
    for position in &mut file.mesh.positions {
        *position = Vector3::from_fn(|axis, _| scale * semi_axes[axis] * position[axis]);
    }
    file
}

/// A cylinder around z, centered at the origin.
pub(crate) fn cylinder(radius: f64, height: f64, sectors: usize) -> SurfaceFile {
    // The inscribed prism is scaled to the area of the circle.
    let angle = std::f64::consts::TAU / sectors as f64;
    let radius = radius * (angle / angle.sin()).sqrt();
    let rings = 20;
    let side = (0..=rings).map(|ring| [radius, height / 2.0 - height * ring as f64 / rings as f64]);
    let profile: Vec<[f64; 2]> = [[0.0, height / 2.0]].into_iter().chain(side).chain([[0.0, -height / 2.0]]).collect();
    revolved(&profile, sectors)
}

/// The volume that the surface encloses.
pub(crate) fn volume(file: &SurfaceFile) -> f64 {
    let corner = |vertex: u32| file.mesh.positions[vertex as usize];
    let tetrahedra = file.mesh.triangles.iter().map(|[a, b, c]| corner(*a).dot(&corner(*b).cross(&corner(*c))) / 6.0);
    tetrahedra.sum()
}

/// Turns a surface by a random rotation. Seed 0 leaves it as it is.
pub(crate) fn rotated(mut file: SurfaceFile, seed: u64) -> SurfaceFile {
    if seed > 0 {
        let mut random = fastrand::Rng::with_seed(seed);
        let axis = Unit::new_normalize(Vector3::from_fn(|_, _| random.f64() - 0.5));
        let rotation = Rotation3::from_axis_angle(&axis, 0.5 + 2.0 * random.f64());
        file.mesh.positions.iter_mut().for_each(|position| *position = rotation * *position);
    }
    file
}

/// Deletes 5 % of the triangles and turns 1 % over.
pub(crate) fn damaged(mut file: SurfaceFile, seed: u64) -> SurfaceFile {
    let mut random = fastrand::Rng::with_seed(seed);
    let mesh = &mut file.mesh;
    mesh.triangles.retain(|_| random.f64() > 0.05);
    for triangle in &mut mesh.triangles {
        if random.f64() < 0.01 {
            triangle.swap(1, 2);
        }
    }
    let count = mesh.triangles.len();
    mesh.corner_normals.truncate(count);
    mesh.triangle_groups.truncate(count);
    mesh.triangle_materials.truncate(count);
    file
}
