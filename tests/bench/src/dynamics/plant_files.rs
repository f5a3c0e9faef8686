//! Generates plants of any number of domains, as the files that the loader of plants reads: an OBJ file, the object of each
//! face, and the structure. Every shoot carries three shoots and nine leaves, as long as there are any.

use std::fmt::Write as _;
use std::path::Path;

use modalcast_model::error::{Result, fault_in};
use nalgebra::{Rotation3, Unit, Vector3};

/// Domains per shoot: the shoot and its leaves.
pub(super) const DOMAINS_PER_SHOOT: usize = 10;

/// Shoots per shoot.
const CHILDREN: usize = 3;

/// Length and radius of the trunk in meters.
const TRUNK: [f64; 2] = [1.5, 0.03];

/// Ratios of length and radius of a shoot to those of its parent.
const RATIOS: [f64; 2] = [0.75, 0.6];

/// Points of the polyline of a shoot, and sides of a tube.
const POINTS: usize = 7;
const SIDES: usize = 6;

/// The angle between neighbors around a shoot, in radians: the golden angle, as in many plants.
const DIVERGENCE: f64 = 2.399_963;

/// The files under construction.
#[derive(Default)]
struct PlantFiles {
    obj: String,
    vertex_count: usize,
    /// The object of each face.
    object_ids: String,
    /// Entries of the structure.
    objects: Vec<String>,
    shoots: Vec<String>,
    leaves: Vec<String>,
}

/// A straight shoot.
struct Shoot {
    base: Vector3<f64>,
    /// The axis z points along the shoot.
    axes: Rotation3<f64>,
    length: f64,
    radius: f64,
}

impl Shoot {
    /// The point at a fraction of the length.
    fn point(&self, fraction: f64) -> Vector3<f64> {
        self.base + self.axes * Vector3::z() * (fraction * self.length)
    }

    /// Axes that are tilted away from those of the shoot, at an angle around it.
    fn tilted_axes(&self, around: f64, tilt: f64) -> Rotation3<f64> {
        let axis = Unit::new_normalize(Vector3::new(around.cos(), around.sin(), 0.0));
        self.axes * Rotation3::from_axis_angle(&axis, tilt)
    }
}

/// Writes a plant of `shoot_count` shoots with their leaves into a folder, as `plant.obj` and the files beside it.
///
/// # Errors
/// `Fault` if a file cannot be written.
pub(super) fn write_plant(folder: &Path, shoot_count: usize) -> Result<()> {
    let mut files = PlantFiles::default();
    let mut shoots: Vec<Shoot> = vec![];
    for index in 0..shoot_count {
        let shoot = match index.checked_sub(1) {
            None => Shoot { base: Vector3::zeros(), axes: Rotation3::identity(), length: TRUNK[0], radius: TRUNK[1] },
            Some(ordinal) => {
                let parent = &shoots[ordinal / CHILDREN];
                let axes = parent.tilted_axes(DIVERGENCE * ordinal as f64, 0.7);
                let base = parent.point(0.5 + 0.2 * (ordinal % CHILDREN) as f64);
                Shoot { base, axes, length: RATIOS[0] * parent.length, radius: RATIOS[1] * parent.radius }
            }
        };
        files.add_shoot(index.checked_sub(1).map(|ordinal| ordinal / CHILDREN), &shoot);
        for leaf in 0..DOMAINS_PER_SHOOT - 1 {
            let position = shoot.point(0.2 + 0.8 * leaf as f64 / (DOMAINS_PER_SHOOT - 2) as f64);
            files.add_leaf(index, leaf, &position, &shoot.tilted_axes(DIVERGENCE * leaf as f64, 1.0));
        }
        shoots.push(shoot);
    }
    files.write(folder)
}

impl PlantFiles {
    /// Adds an object with faces of vertices of its own. Returns its id.
    fn add_object(&mut self, kind: &str, points: &[Vector3<f64>], faces: &[[usize; 3]]) -> usize {
        let id = self.objects.len() + 1;
        self.objects.push(format!("\"{id}\": \"{kind}\""));
        for point in points {
            self.obj.push_str(&format!("v {} {} {}\n", point.x, point.y, point.z));
        }
        for face in faces {
            // Indices of OBJ files begin with 1.
            let [a, b, c] = face.map(|corner| corner + self.vertex_count + 1);
            self.obj.push_str(&format!("f {a} {b} {c}\n"));
            self.object_ids.push_str(&format!("{id}\n"));
        }
        self.vertex_count += points.len();
        id
    }

    /// Adds a tube along points on a line. `axes` has the line as its axis z.
    fn add_tube(&mut self, kind: &str, line: &[(Vector3<f64>, f64)], axes: &Rotation3<f64>) {
        let side = |side: usize| {
            let angle = std::f64::consts::TAU * side as f64 / SIDES as f64;
            axes * Vector3::new(angle.cos(), angle.sin(), 0.0)
        };
        let ring = |(center, radius): &(Vector3<f64>, f64)| {
            let (center, radius) = (*center, *radius);
            (0..SIDES).map(move |index| center + side(index) * radius)
        };
        let points: Vec<Vector3<f64>> = line.iter().flat_map(ring).collect();
        let mut faces = vec![];
        for row in 0..line.len() - 1 {
            for side in 0..SIDES {
                let corner = |row: usize, side: usize| SIDES * row + side % SIDES;
                faces.push([corner(row, side), corner(row, side + 1), corner(row + 1, side + 1)]);
                faces.push([corner(row, side), corner(row + 1, side + 1), corner(row + 1, side)]);
            }
        }
        self.add_object(kind, &points, &faces);
    }

    fn add_shoot(&mut self, parent: Option<usize>, shoot: &Shoot) {
        let fraction = |point: usize| point as f64 / (POINTS - 1) as f64;
        // The tip is as thick as the base of a child.
        let radius = |point: usize| shoot.radius * (1.0 - (1.0 - RATIOS[1]) * fraction(point));
        let line: Vec<(Vector3<f64>, f64)> =
            (0..POINTS).map(|point| (shoot.point(fraction(point)), radius(point))).collect();
        self.add_tube("internode", &line, &shoot.axes);
        let vertices: Vec<String> = line.iter().map(|(center, _)| point_text(center)).collect();
        let radii: Vec<String> = line.iter().map(|(_, radius)| radius.to_string()).collect();
        let parent = parent.map_or_else(|| "-1".to_owned(), |parent| parent.to_string());
        self.shoots.push(format!(
            "{{\"id\": {}, \"parent\": {parent}, \"vertices\": [{}], \"radii\": [{}]}}",
            self.shoots.len(),
            vertices.join(","),
            radii.join(",")
        ));
    }

    /// Adds a leaf: a petiole of 4 cm along the axis z, and a blade of 8 cm that bends down.
    fn add_leaf(&mut self, shoot: usize, node: usize, base: &Vector3<f64>, axes: &Rotation3<f64>) {
        let place = |x: f64, y: f64, z: f64| base + axes * Vector3::new(x, y, z);
        let (start, end) = (place(0.0, 0.0, 0.0), place(0.0, 0.0, 0.04));
        self.add_tube("petiole", &[(start, 6e-4), (end, 5e-4)], axes);
        let blade = [
            place(0.0, -0.02, 0.04),
            place(0.0, 0.02, 0.04),
            place(0.01, -0.02, 0.08),
            place(0.01, 0.02, 0.08),
            place(0.03, 0.0, 0.12),
        ];
        let id = self.add_object("leaf", &blade, &[[0, 2, 3], [0, 3, 1], [2, 4, 3]]);
        let [start, end] = [start, end].map(|point| point_text(&point));
        self.leaves.push(format!(
            "{{\"object_id\": {id}, \"shoot\": {shoot}, \"node\": {node}, \"petiole\": 0, \"base\": {end}, \
             \"petiole_vertices\": [{start}, {end}]}}"
        ));
    }

    fn write(&self, folder: &Path) -> Result<()> {
        let mut structure = String::new();
        for (name, open, entries, close) in [
            ("objects", "{", &self.objects, "}"),
            ("shoots", "[", &self.shoots, "]"),
            ("leaves", "[", &self.leaves, "]"),
        ] {
            let separator = if structure.is_empty() { "{" } else { ",\n" };
            write!(structure, "{separator}\"{name}\": {open}{}{close}", entries.join(",\n"))
                .map_err(fault_in("plant"))?;
        }
        structure.push_str("}\n");
        let files =
            [("plant.obj", &self.obj), ("plant_object_id.dat", &self.object_ids), ("plant.structure.json", &structure)];
        for (name, text) in files {
            std::fs::write(folder.join(name), text).map_err(fault_in("plant"))?;
        }
        Ok(())
    }
}

fn point_text(point: &Vector3<f64>) -> String {
    format!("[{}, {}, {}]", point.x, point.y, point.z)
}
