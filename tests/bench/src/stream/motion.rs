//! Steps that are sent from memory, so that the physics process does not limit a measurement.

use std::path::Path;
use std::time::Instant;

use modalcast_client::{Client, Delivery, DriveRequest, MAX_STALL_BUDGET, SceneDescription, Step, StepStream};

use super::SCENE;
use modalcast_model::error::{Result, fault_in, invalid};
use modalcast_model::load::{NpyArray, parse_numpy};

/// Seconds per step.
const DT: f64 = 1.0 / 60.0;

/// The values of one step that differ from those of the previous step.
#[derive(Debug, Clone, Default, PartialEq)]
struct StepChanges {
    /// Coordinates of a domain.
    q: Vec<(u32, Vec<f32>)>,
    /// `world_from_domain` of a domain, row-major 3x4.
    transforms: Vec<(u32, [f32; 12])>,
}

/// Steps that repeat. The first one contains all values.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Motion(Vec<StepChanges>);

impl Motion {
    /// Reads the recording of `modalcast-sim`.
    ///
    /// # Errors
    /// `Invalid` when the recording does not match the scene.
    pub(super) fn read(folder: &Path, description: &SceneDescription) -> Result<Self> {
        let (q, transforms) = (read_rows(&folder.join("q.npy"))?, read_rows(&folder.join("transforms.npy"))?);
        let q_ranges = coordinate_ranges(description);
        let coordinates = q_ranges.last().map_or(0, |(_, range)| range.end);
        let domains = description.domains.len();
        for (field, rows, width) in [("q", &q, coordinates), ("transforms", &transforms, 12 * domains)] {
            if let Some(row) = rows.iter().find(|row| row.len() != width) {
                return Err(invalid(field, format!("{width} numbers per step"), row.len()));
            }
        }
        let changes = |(index, (q_row, transform_row)): (usize, (&Vec<f32>, &Vec<f32>))| {
            let previous = index.checked_sub(1).map(|previous| (&q[previous], &transforms[previous]));
            let is_changed = |range: &std::ops::Range<usize>, row: &[f32], previous: Option<&Vec<f32>>| {
                previous.is_none_or(|previous| previous[range.clone()] != row[range.clone()])
            };
            let changed_q = q_ranges.iter().filter(|(_, range)| is_changed(range, q_row, previous.map(|rows| rows.0)));
            let transforms = transform_row.as_chunks().0.iter().enumerate();
            let changed_transforms = transforms.filter(|(domain, _)| {
                is_changed(&(12 * domain..12 * domain + 12), transform_row, previous.map(|rows| rows.1))
            });
            StepChanges {
                q: changed_q.map(|(domain, range)| (*domain, q_row[range.clone()].to_vec())).collect(),
                transforms: changed_transforms.map(|(domain, transform)| (domain as u32, *transform)).collect(),
            }
        };
        Ok(Self(q.iter().zip(&transforms).enumerate().map(changes).collect()))
    }

    /// A motion in which every coordinate oscillates between -1 and 1.
    pub(super) fn oscillation(description: &SceneDescription, steps: u64) -> Self {
        let step = |number: u64| {
            let angle = std::f64::consts::TAU * number as f64 / steps as f64;
            let q_of = |(domain, range): (u32, std::ops::Range<usize>)| {
                (domain, range.map(|coordinate| (angle + coordinate as f64).sin() as f32).collect())
            };
            StepChanges { q: coordinate_ranges(description).into_iter().map(q_of).collect(), transforms: Vec::new() }
        };
        Self((0..steps).map(step).collect())
    }

    /// The step with a number, which counts from 0 for each stream.
    pub(super) fn step(&self, number: u64) -> Step {
        let changes = &self.0[(number % self.0.len() as u64) as usize];
        let mut step = Step::new(number, number as f64 * DT);
        for (domain, coordinates) in &changes.q {
            step.set_q(*domain, coordinates);
        }
        for (domain, transform) in &changes.transforms {
            step.set_transform(*domain, transform);
        }
        step
    }

    /// Bytes of coordinates and transforms of a step, on average.
    pub(super) fn mean_bytes(&self) -> f64 {
        let bytes: usize = (0..self.0.len() as u64).map(|number| self.step(number).payload_bytes()).sum();
        bytes as f64 / self.0.len() as f64
    }
}

/// The coordinates of each domain that has its own, as a range of the coordinates of the scene.
pub(super) fn coordinate_ranges(description: &SceneDescription) -> Vec<(u32, std::ops::Range<usize>)> {
    let mut first = 0;
    let owners = description.domains.iter().filter(|domain| domain.rank > 0 && domain.shares_q_with.is_none());
    owners
        .map(|domain| {
            first += domain.rank;
            (domain.index as u32, first - domain.rank..first)
        })
        .collect()
}

/// The rows of a `.npy` file; all dimensions but the first are flattened.
fn read_rows(path: &Path) -> Result<Vec<Vec<f32>>> {
    let NpyArray { shape, entries, .. } = parse_numpy(&std::fs::read(path).map_err(fault_in("report"))?)?;
    let rows = shape.first().copied().unwrap_or(0);
    // A scene without coordinates has rows without numbers.
    let width = shape.iter().skip(1).product::<usize>();
    Ok((0..rows).map(|row| entries[row * width..(row + 1) * width].to_vec()).collect())
}

/// Opens a lossless step stream. `window` limits the steps in flight.
pub(super) async fn open_writer(client: &Client, window: Option<u32>) -> Result<StepStream> {
    // A measurement needs every step, also at a slow reader.
    let request = DriveRequest::new(SCENE, Delivery::Lossless).take_over().stall_budget(MAX_STALL_BUDGET);
    let request = window.into_iter().fold(request, DriveRequest::window);
    client.drive(&request).await.map_err(fault_in("report"))
}

/// Sends steps without a wait for acknowledgments. Returns the steps per second, from the first step to the last
/// acknowledgment.
pub(super) async fn measure_rate(client: &Client, motion: &Motion, steps: u64) -> Result<f64> {
    let mut writer = open_writer(client, None).await?;
    let start = Instant::now();
    for number in 0..steps {
        writer.step(&motion.step(number)).await.map_err(fault_in("report"))?;
        writer.take_acks();
    }
    writer.flush().await.map_err(fault_in("report"))?;
    let seconds = start.elapsed().as_secs_f64();
    writer.finish().await.map_err(fault_in("report"))?;
    Ok(steps as f64 / seconds)
}

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_client::Domain;
    use modalcast_client::npy::Writer;

    /// Domains of 2, 2 (shared with the first) and 1 coordinates.
    fn description() -> SceneDescription {
        let domain = |index, rank, shares_q_with| Domain { index, rank, shares_q_with, ..Domain::default() };
        let domains = vec![domain(0, 2, None), domain(1, 2, Some(0)), domain(2, 1, None)];
        SceneDescription { domains, ..SceneDescription::default() }
    }

    fn write_rows(path: &Path, shape: &[usize], rows: &[Vec<f32>]) {
        let mut writer = Writer::create(path, shape).expect("expected a file");
        rows.iter().for_each(|row| writer.write_row(row).expect("expected a row"));
        writer.finish().expect("expected a complete file");
    }

    #[test]
    fn recorded_steps_contain_only_changed_values() {
        let folder = tempfile::tempdir().expect("expected a folder");
        write_rows(&folder.path().join("q.npy"), &[3], &[vec![1.0, 2.0, 3.0], vec![1.0, 2.0, 4.0]]);
        let mut transforms = [vec![0.0; 36], vec![0.0; 36]];
        transforms[1][13] = 5.0;
        write_rows(&folder.path().join("transforms.npy"), &[3, 12], &transforms);
        let motion = Motion::read(folder.path(), &description()).expect("expected a motion");
        // Three coordinates, and three transforms of 12 numbers; then one coordinate and one transform.
        assert_eq!([0, 1, 2].map(|number| motion.step(number).payload_bytes()), [4 * 39, 4 * 13, 4 * 39]);
        let wire = motion.step(1).to_wire();
        assert_eq!((wire.number, wire.q_domains, wire.transform_domains), (1, vec![2], vec![1]));
        assert_eq!(motion.mean_bytes(), 2.0 * 52.0);
        write_rows(&folder.path().join("q.npy"), &[2], &[vec![1.0, 2.0], vec![1.0, 2.0]]);
        let error = Motion::read(folder.path(), &description()).expect_err("expected wrong rows").to_string();
        assert_eq!(error, "q: expected 3 numbers per step, got 2");
    }

    #[test]
    fn oscillation_moves_every_coordinate() {
        let motion = Motion::oscillation(&description(), 8);
        assert_eq!(motion.step(3).to_wire().q_domains, [0, 2]);
        assert_ne!(motion.step(3).to_wire().q, motion.step(4).to_wire().q);
        assert_eq!(motion.step(3).to_wire().q, motion.step(11).to_wire().q);
    }
}
