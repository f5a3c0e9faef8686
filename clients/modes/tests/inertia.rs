//! The mass properties of free bodies, as the server reads them from a model file.

mod solids;

use modalcast_modes::model_file::encode;
use modalcast_modes::part_file::ModelSource;
use nalgebra::Vector3;

/// A box of 280 kg whose center is not at the origin, in a file whose up axis is y.
#[test]
fn free_box_has_its_mass_and_moments_in_the_file() {
    let (size, center) = ([1.0, 0.7, 0.4], Vector3::new(0.3, -0.2, 0.5));
    let mut file = solids::solid_box(size);
    file.mesh.positions.iter_mut().for_each(|position| *position += center);
    let parameters = solids::parameters(1_500, 4);
    let modeling = solids::compute(&file, &parameters);
    let source = ModelSource { name: "box", sha256: "0", up_axis: 1 };
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("box.npz");
    std::fs::write(&path, encode(source, &parameters, &modeling).expect("a model")).expect("a file");
    let scene = modalcast_model::load::open(path.to_str().expect("a path")).expect("a scene").scene;
    let inertia = scene.domains[0].metadata.inertia.clone().expect("an inertia");
    let mass = 280.0;
    assert!((inertia.mass() / mass - 1.0).abs() < 1e-6, "{}", inertia.mass());
    // y becomes z, and z becomes -y.
    let turned = Vector3::new(center.x, -center.z, center.y);
    assert!((Vector3::from(inertia.center()) - turned).norm() < 1e-6, "{:?}", inertia.center());
    let [x, y, z] = [size[0], size[2], size[1]];
    let about_center = Vector3::new(y * y + z * z, x * x + z * z, x * x + y * y) * (mass / 12.0);
    let moment = |axis: usize| about_center[axis] + mass * (turned.norm_squared() - turned[axis] * turned[axis]);
    let product = |a: usize, b: usize| -mass * turned[a] * turned[b];
    let expected = [moment(0), moment(1), moment(2), product(0, 1), product(0, 2), product(1, 2)];
    for (given, expected) in inertia.moments().into_iter().zip(expected) {
        assert!((given - expected).abs() < 1e-3 * mass, "{:?}, expected {expected}", inertia.moments());
    }
    // The modes of a free body have no momentum, and unit mass.
    let masses = inertia.mass_matrix();
    let modal = masses.view((6, 6), (4, 4)).into_owned() - nalgebra::DMatrix::<f64>::identity(4, 4);
    assert!(modal.amax() < 1e-6 && masses.view((0, 6), (6, 4)).amax() < 1e-6 * mass.sqrt(), "{masses}");
    // Control: a body in a clamp has modes with momentum, and no inertia in the file.
    let clamped = modalcast_modes::ModelingParameters { clamps: vec!["x < -0.1".into()], ..parameters };
    assert!(solids::compute(&file, &clamped).mass_properties.is_none());
}
