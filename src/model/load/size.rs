//! A remark on the size of a scene whose files do not say their unit of length, such as a part in millimeters.

use std::ops::RangeInclusive;

use crate::rounding::to_significant_digits;
use crate::scene::Scene;

/// Diagonals of plausible scenes in meters. Most parts and buildings are smaller than the upper limit. In millimeters, a
/// part of 50 mm exceeds it.
const PLAUSIBLE_DIAGONALS: RangeInclusive<f64> = 1e-3..=50.0;

/// A remark if the scene has an implausible size. It is for scenes whose unit is not known.
pub(super) fn implausible_size(scene: &Scene) -> Option<String> {
    let bounds = scene.rest_bounds;
    let diagonal = scene.unit * bounds.diagonal();
    // A scene of a single point has no size.
    if !diagonal.is_normal() || PLAUSIBLE_DIAGONALS.contains(&diagonal) {
        return None;
    }
    let [x, y, z] = [0, 1, 2].map(|axis| rounded(scene.unit * (bounds.max[axis] - bounds.min[axis])));
    let advice = match diagonal > *PLAUSIBLE_DIAGONALS.end() {
        true => "if its file is in millimeters, pass --unit mm, or set unit = 'mm' in scene.toml",
        false => "if its file is not in meters, pass --unit, or set `unit` in scene.toml",
    };
    Some(format!("the scene is {x} x {y} x {z} m; {advice}"))
}

/// A length with three significant digits. Large and small numbers have an exponent.
fn rounded(length: f64) -> String {
    let number = to_significant_digits(length, 3);
    if number == 0.0 || (1e-4..1e6).contains(&number) { number.to_string() } else { format!("{length:.2e}") }
}

#[cfg(test)]
mod tests {
    use std::fmt::Write as _;

    use crate::load::{LoadOptions, open_with};
    use crate::scene::{LengthUnit, UpAxis};

    /// A box of 18 x 128 x 6 units in a file of each format without a unit.
    fn write_box(folder: &std::path::Path, scale: f64) {
        let corners: Vec<[f64; 3]> = (0..8_u32)
            .map(|corner| [0, 1, 2].map(|axis| scale * [18.0, 128.0, 6.0][axis] * f64::from(corner >> axis & 1)))
            .collect();
        let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let mut obj = String::new();
        let mut ply = "ply\nformat ascii 1.0\nelement vertex 8\nproperty double x\nproperty double y\n\
                       property double z\nelement face 6\nproperty list uchar int vertex_indices\nend_header\n"
            .to_owned();
        let mut stl = "solid\n".to_owned();
        for [x, y, z] in &corners {
            writeln!(obj, "v {x} {y} {z}").expect("a text");
            writeln!(ply, "{x} {y} {z}").expect("a text");
        }
        for [a, b, c, d] in quads {
            writeln!(obj, "f {} {} {} {}", a + 1, b + 1, c + 1, d + 1).expect("a text");
            writeln!(ply, "4 {a} {b} {c} {d}").expect("a text");
            for triangle in [[a, b, c], [a, c, d]] {
                stl.push_str("facet normal 0 0 0\nouter loop\n");
                for [x, y, z] in triangle.map(|corner: usize| corners[corner]) {
                    writeln!(stl, "vertex {x} {y} {z}").expect("a text");
                }
                stl.push_str("endloop\nendfacet\n");
            }
        }
        stl.push_str("endsolid\n");
        for (name, text) in [("a.obj", obj), ("a.ply", ply), ("a.stl", stl)] {
            std::fs::write(folder.join(name), text).expect("a writable file");
        }
    }

    fn remarks(path: &std::path::Path, options: LoadOptions) -> Vec<String> {
        open_with(&path.to_string_lossy(), &options).expect("a scene").scene.remarks.clone()
    }

    #[test]
    fn implausible_size_is_a_remark_unless_the_unit_is_given() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        write_box(folder.path(), 1.0);
        let expected = "the scene is 18 x 128 x 6 m; if its file is in millimeters, pass --unit mm, or set unit = 'mm' \
                        in scene.toml";
        let any_unit = |unit: &str| LoadOptions { unit: Some(unit.parse().expect("a unit")), ..LoadOptions::default() };
        for name in ["a.obj", "a.ply", "a.stl"] {
            let path = folder.path().join(name);
            assert_eq!(remarks(&path, LoadOptions::default()), [expected], "{name}");
            let strict = LoadOptions { is_strict: true, ..LoadOptions::default() };
            assert_eq!(remarks(&path, strict), [expected], "{name}: no error in strict mode");
            for unit in ["mm", "m"] {
                assert_eq!(remarks(&path, any_unit(unit)), [""; 0], "{name} in {unit}");
            }
        }
        let manifest = folder.path().join("scene.toml");
        for (unit, count) in [("", 1), ("unit = 'mm'\n", 0), ("unit = 1\n", 0)] {
            std::fs::write(&manifest, format!("model = 'a.obj'\n{unit}")).expect("a writable file");
            assert_eq!(remarks(&manifest, LoadOptions::default()).len(), count, "{unit}");
            assert_eq!(remarks(&manifest, any_unit("cm")), [""; 0], "{unit}");
        }
    }

    #[test]
    fn limits_are_those_of_parts_and_buildings() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("a.obj");
        for (scale, start) in [
            (0.3, None),
            (0.001, None),
            (1e-5, None),
            (0.5, Some("the scene is 9 x 64 x 3 m; if its file is in millimeters")),
            (1e-6, Some("the scene is 1.80e-5 x 0.000128 x 6.00e-6 m; if its file is not in meters")),
            (1e9, Some("the scene is 1.80e10 x 1.28e11 x 6.00e9 m; if its file is in millimeters")),
        ] {
            write_box(folder.path(), scale);
            let remarks = remarks(&path, LoadOptions::default());
            match start {
                Some(start) => assert!(remarks.len() == 1 && remarks[0].starts_with(start), "{scale}: {remarks:?}"),
                None => assert_eq!(remarks, [""; 0], "{scale}"),
            }
        }
    }

    /// The options behave as the keys of `scene.toml`.
    #[test]
    fn unit_and_up_axis_of_the_options_win() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        write_box(folder.path(), 1.0);
        std::fs::write(folder.path().join("scene.toml"), "model = 'a.stl'\nunit = 'ft'\nup = 'y'\n").expect("a file");
        let open = |name: &str, unit: Option<f64>, up: Option<UpAxis>| {
            let unit = unit.map(|meters| LengthUnit::from_meters(meters).expect("a unit"));
            let options = LoadOptions { unit, up, ..LoadOptions::default() };
            let path = folder.path().join(name);
            let scene = open_with(&path.to_string_lossy(), &options).expect(name).scene;
            (scene.unit, scene.up)
        };
        let (unit, up) = (Some(0.001), Some(UpAxis::X));
        assert_eq!(open("a.stl", None, None), (1.0, UpAxis::Z));
        assert_eq!(open("scene.toml", None, None), (0.3048, UpAxis::Y));
        for name in ["a.stl", "scene.toml"] {
            assert_eq!(open(name, unit, up), (0.001, UpAxis::X), "{name}");
            assert_eq!(open(name, unit, None).1, open(name, None, None).1, "{name}");
            assert_eq!(open(name, None, up).0, open(name, None, None).0, "{name}");
        }
        let tree = LoadOptions {
            unit: Some(LengthUnit::METER),
            up: Some(UpAxis::Z),
            is_strict: true,
            ..LoadOptions::default()
        };
        assert_eq!(open_with("tree", &tree).expect("the built-in scene").scene.up, UpAxis::Z);
    }
}
