//! The result table of a report: one row per variant, load and cache state.

use serde::Serialize;

use super::bench::MemoryBandwidth;
use super::csv_table;
use super::memory_traffic::{self, Operand};
use super::timing::{CacheState, Timing};
use super::validate::ValidationResult;
use super::variant::VariantLabel;
use crate::kernels::KernelAttributes;
use modalcast_model::deform::Backend;
use modalcast_model::error::{Error, Result, fault_in};
use modalcast_model::scene::{NormalMethod, StorageType};

/// Results of one variant on one load with one cache state.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DeformRow {
    pub load: String,
    pub name: String,
    pub backend: Backend,
    pub storage: StorageType,
    pub normals: NormalMethod,
    pub compensated: bool,
    pub cache: CacheState,
    pub passed: bool,
    /// Reasons why the variant failed or was skipped.
    pub faults: Vec<String>,
    /// Whether the variant was skipped because the machine lacks something. A skipped variant does not count as failed.
    #[serde(rename = "left_out")]
    pub is_skipped: bool,
    /// `None` when the variant failed, or cannot be timed with this cache state.
    pub timing: Option<Timing>,
    /// Minimum memory traffic of a step.
    pub bytes: u64,
    /// The same traffic per operand.
    pub traffic: Vec<Operand>,
    /// Bytes divided by the median time, 10^9 per second.
    pub gbs: Option<f64>,
    /// `gbs` divided by the peak copy bandwidth of the same run.
    pub of_copy: Option<f64>,
    /// `gbs` divided by the peak read bandwidth of the same run.
    pub of_read: Option<f64>,
    /// Kernel launches per step; 0 on the CPU.
    pub launches: usize,
    /// The driver's attributes of each kernel; empty on the CPU.
    pub kernels: Vec<KernelAttributes>,
    /// `None` when the variant could not be created.
    #[serde(rename = "found")]
    pub validation: Option<ValidationResult>,
}

impl DeformRow {
    /// The row of a validated variant.
    pub fn new(
        load: &str,
        label: &VariantLabel,
        validation: ValidationResult,
        traffic: Vec<Operand>,
        (cache, timing): (CacheState, Option<Timing>),
    ) -> Self {
        let bytes = memory_traffic::total_bytes(&traffic);
        Self {
            cache,
            passed: validation.passed(),
            faults: validation.faults.clone(),
            is_skipped: validation.is_skipped,
            timing,
            bytes,
            traffic,
            // 1 GB/s is 1e3 bytes per microsecond.
            gbs: timing.map(|timing| bytes as f64 / timing.median_us / 1e3),
            validation: Some(validation),
            ..Self::empty(load, label)
        }
    }

    /// The row of a variant that could not be created.
    pub fn not_created(load: &str, label: &VariantLabel, error: &Error) -> Self {
        let is_skipped = matches!(error, Error::Unavailable { .. });
        Self { faults: vec![error.to_string()], is_skipped, ..Self::empty(load, label) }
    }

    /// A row without results.
    fn empty(load: &str, label: &VariantLabel) -> Self {
        Self {
            load: load.into(),
            name: label.name.clone(),
            backend: label.backend,
            storage: label.deformation.storage,
            normals: label.deformation.normals,
            compensated: label.deformation.compensated,
            cache: CacheState::Warm,
            passed: false,
            faults: Vec::new(),
            is_skipped: false,
            timing: None,
            bytes: 0,
            traffic: Vec::new(),
            gbs: None,
            of_copy: None,
            of_read: None,
            launches: 0,
            kernels: Vec::new(),
            validation: None,
        }
    }

    /// The row with its bandwidth divided by the peak bandwidths of the machine.
    pub fn relative_to(mut self, bandwidth: MemoryBandwidth) -> Self {
        let fraction_of = |peak_gbs: Option<f64>| Some(self.gbs? / peak_gbs.filter(|peak_gbs| *peak_gbs > 0.0)?);
        (self.of_copy, self.of_read) = (fraction_of(bandwidth.copy_gbs), fraction_of(bandwidth.read_gbs));
        self
    }

    /// Time, and largest error as a fraction of the diagonal; `None` when the variant failed or was not timed.
    pub fn time_and_error(&self) -> Option<TimeAndError> {
        let validation = self.validation.as_ref().filter(|_| self.passed)?;
        let Timing { median_us, q1_us, q3_us, .. } = self.timing?;
        let error = validation.errors.of_diagonal.largest;
        Some(TimeAndError { time_us: median_us, quartiles_us: [q1_us, q3_us], error })
    }
}

/// Columns of `report.csv`: name, and JSON pointer of the value in a row of `report.json`. The pointer is empty for
/// columns that `csv` computes. `of_copy` and `of_read` are fractions of peak bandwidths, `of_diagonal` and `of_bound`
/// are fractions of the scene's diagonal and of the a-priori bound. `step_` columns are errors of the displacement
/// between consecutive steps. `left_out` is true for a skipped variant.
const COLUMNS: [(&str, &str); 53] = [
    ("load", "/load"),
    ("variant", "/name"),
    ("backend", "/backend"),
    ("storage", "/storage"),
    ("normals", "/normals"),
    ("compensated", "/compensated"),
    ("cache", "/cache"),
    ("passed", "/passed"),
    ("median_us", "/timing/median_us"),
    ("q1_us", "/timing/q1_us"),
    ("q3_us", "/timing/q3_us"),
    ("replays", "/timing/replays"),
    ("bytes", "/bytes"),
    ("gb_per_s", "/gbs"),
    ("launches", "/launches"),
    ("of_copy", "/of_copy"),
    ("of_read", "/of_read"),
    ("states", "/found/errors/states"),
    ("largest_m", "/found/errors/metres/largest"),
    ("rms_m", "/found/errors/metres/rms"),
    ("largest_of_diagonal", "/found/errors/of_diagonal/largest"),
    ("rms_of_diagonal", "/found/errors/of_diagonal/rms"),
    ("largest_px", "/found/errors/pixels/largest"),
    ("rms_px", "/found/errors/pixels/rms"),
    ("bias_x_m", "/found/errors/bias_metres/0"),
    ("bias_y_m", "/found/errors/bias_metres/1"),
    ("bias_z_m", "/found/errors/bias_metres/2"),
    ("step_largest_m", "/found/step_metres/largest"),
    ("step_rms_m", "/found/step_metres/rms"),
    ("bound_m", "/found/errors/bound_metres"),
    ("of_bound", "/found/errors/of_bound"),
    ("not_finite", "/found/errors/not_finite"),
    ("repeatable", "/found/repeatable"),
    ("storage_largest_m", "/found/sources/storage/largest"),
    ("storage_rms_m", "/found/sources/storage/rms"),
    ("q_largest_m", "/found/sources/q/largest"),
    ("q_rms_m", "/found/sources/q/rms"),
    ("accumulation_largest_m", "/found/sources/accumulation/largest"),
    ("accumulation_rms_m", "/found/sources/accumulation/rms"),
    ("transform_largest_m", "/found/sources/transform/largest"),
    ("transform_rms_m", "/found/sources/transform/rms"),
    ("origin_largest_m", "/found/sources/origin/largest"),
    ("origin_rms_m", "/found/sources/origin/rms"),
    ("normals_largest_deg", "/found/orientation/normals_degrees/largest"),
    ("normals_rms_deg", "/found/orientation/normals_degrees/rms"),
    ("normals_to_surface_largest_deg", "/found/orientation/normals_to_surface_degrees/largest"),
    ("normals_to_surface_rms_deg", "/found/orientation/normals_to_surface_degrees/rms"),
    ("left_out", "/left_out"),
    ("tangents_largest_deg", "/found/orientation/tangents_degrees/largest"),
    ("tangents_rms_deg", "/found/orientation/tangents_degrees/rms"),
    ("normal_dot_tangent", "/found/orientation/normal_dot_tangent/largest"),
    ("bytes_by_formula", ""),
    ("faults", ""),
];

/// The rows as CSV with a header.
///
/// # Errors
/// `Fault` when writing into memory fails.
pub fn csv(rows: &[DeformRow]) -> Result<Vec<u8>> {
    let mut lines = Vec::new();
    for row in rows {
        let value = serde_json::to_value(row).map_err(fault_in("report"))?;
        lines.push(COLUMNS.map(|(name, pointer)| match name {
            "bytes_by_formula" => memory_traffic::format_operands(&row.traffic),
            "faults" => row.faults.join("; "),
            _ => csv_table::cell_text(&value, pointer),
        }));
    }
    csv_table::encode(COLUMNS.map(|(name, _)| name.to_owned()), lines)
}

/// Relative difference of times or errors below which one variant does not count as better than another.
const MIN_RELATIVE_GAIN: f64 = 1e-3;

/// Time and error of a variant, and the quartiles of the time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TimeAndError {
    pub time_us: f64,
    /// First and third quartile; both are `time_us` if they were not measured.
    pub quartiles_us: [f64; 2],
    pub error: f64,
}

impl TimeAndError {
    /// Whether the time is smaller than that of `other` by more than noise: the quartiles do not overlap, and the
    /// difference is more than `MIN_RELATIVE_GAIN`.
    pub fn is_faster_than(&self, other: &Self) -> bool {
        self.quartiles_us[1] < other.quartiles_us[0] && self.time_us < other.time_us * (1.0 - MIN_RELATIVE_GAIN)
    }

    /// Whether neither time is smaller than the other by more than noise.
    pub fn has_time_of(&self, other: &Self) -> bool {
        !self.is_faster_than(other) && !other.is_faster_than(self)
    }
}

/// Pareto front of times and errors: the indices of the points that no other point dominates, by ascending time. Of
/// points that differ only by noise in time, or by less than `MIN_RELATIVE_GAIN` in error, one is on the front.
pub fn pareto_front(points: &[TimeAndError]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..points.len()).collect();
    order.sort_by(|a, b| {
        let (a, b) = (&points[*a], &points[*b]);
        a.time_us.total_cmp(&b.time_us).then(a.error.total_cmp(&b.error))
    });
    let mut min_error = f64::INFINITY;
    order.retain(|index| {
        let is_smaller = points[*index].error < min_error;
        min_error = min_error.min(points[*index].error);
        is_smaller
    });
    // From the smallest error to the shortest time. Each point is compared with the last one that remains, so that a
    // chain of small differences does not remove a point that differs from all others by more than noise.
    let mut front: Vec<usize> = Vec::new();
    for index in order.into_iter().rev() {
        let point = &points[index];
        match front.last().map(|last| &points[*last]) {
            Some(last) if !point.is_faster_than(last) => continue,
            Some(last) if last.error >= point.error * (1.0 - MIN_RELATIVE_GAIN) => {
                front.pop();
            }
            _ => {}
        }
        front.push(index);
    }
    front.reverse();
    front
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::error_sources::ErrorSources;
    use crate::errors::{ErrorNorms, OrientationErrors, PositionErrors};

    /// A row with 2,000 bytes of traffic and this median time. `error` is the largest error in meters and also as a
    /// fraction of the diagonal.
    pub(crate) fn row(load: &str, name: &str, cache: CacheState, (median_us, error): (f64, f64)) -> DeformRow {
        let label = VariantLabel { name: name.into(), backend: Backend::Cpu, deformation: Default::default() };
        let norms = ErrorNorms { largest: error, rms: error / 2.0 };
        let errors = PositionErrors {
            meters: norms,
            of_diagonal: norms,
            pixels: None,
            bias_meters: [0.5, -0.5, 0.0],
            bound_meters: 1.0,
            of_bound: 0.5,
            not_finite: 0,
            states: 1,
        };
        let validation = ValidationResult {
            errors,
            step_meters: norms,
            sources: ErrorSources::default(),
            orientation: OrientationErrors::default(),
            repeatable: true,
            faults: Vec::new(),
            is_skipped: false,
        };
        let timing = Timing { median_us, q1_us: median_us, q3_us: median_us, replays: 20 };
        let traffic = vec![Operand { name: "U", formula: "4 x sum 3 n r", bytes: 2_000 }];
        DeformRow::new(load, &label, validation, traffic, (cache, Some(timing)))
    }

    /// A point whose quartiles are the time minus and plus `noise_us`.
    fn point((time_us, noise_us): (f64, f64), error: f64) -> TimeAndError {
        TimeAndError { time_us, quartiles_us: [time_us - noise_us, time_us + noise_us], error }
    }

    #[test]
    fn front_contains_exactly_the_pareto_optimal_points() {
        let points = [(1.0, 5.0), (2.0, 6.0), (3.0, 1.0), (3.0, 0.5), (4.0, 0.5), (0.5, 9.0)];
        let points = points.map(|(time_us, error)| point((time_us, 0.0), error));
        assert_eq!(pareto_front(&points), [5, 0, 3]);
        assert_eq!(pareto_front(&[]), [0; 0]);
        assert_eq!(pareto_front(&[points[0], points[0]]).len(), 1, "expected one of two equal points");
    }

    #[test]
    fn front_ignores_gains_within_noise_and_of_a_thousandth() {
        let exact = |time_us: f64, error: f64| point((time_us, 0.0), error);
        assert_eq!(pareto_front(&[exact(1.0, 2.0), exact(1.0005, 1.0)]), [1], "a time of 0.05 % less");
        assert_eq!(pareto_front(&[exact(1.0, 2.0), exact(1.01, 1.0)]), [0, 1]);
        assert_eq!(pareto_front(&[exact(1.0, 1.0), exact(2.0, 0.9995)]), [0], "an error of 0.05 % less");
        assert_eq!(pareto_front(&[exact(1.0, 1.0), exact(2.0, 0.99)]), [0, 1]);
        let noisy = [point((10.0, 1.0), 3.0), point((11.0, 1.0), 2.0), point((12.0, 0.5), 1.0)];
        assert_eq!(pareto_front(&noisy), [0, 2], "the second time is that of the third");
        let distinct = [point((10.0, 0.1), 3.0), point((11.0, 0.1), 2.0), point((12.0, 0.1), 1.0)];
        assert_eq!(pareto_front(&distinct), [0, 1, 2]);
    }

    #[test]
    fn bandwidth_is_bytes_per_time_and_relative_to_the_peak() {
        // 2,000 bytes in 2 us are 1 GB/s.
        let row = row("a", "x", CacheState::Warm, (2.0, 0.1));
        assert_eq!((row.gbs, row.of_copy), (Some(1.0), None));
        let relative = row.relative_to(MemoryBandwidth { copy_gbs: Some(4.0), ..MemoryBandwidth::default() });
        assert_eq!((relative.of_copy, relative.of_read), (Some(0.25), None));
    }

    #[test]
    fn csv_reads_back_all_columns_and_quoted_text() {
        let mut quoted = row("a", "odd, \"name\"", CacheState::Cold, (3.0, 1e-9));
        quoted.faults = vec!["one".into(), "two, three".into()];
        let rows = [row("a", "x", CacheState::Warm, (2.0, 0.125)), quoted];
        let bytes = csv(&rows).expect("written");
        let mut reader = csv::Reader::from_reader(bytes.as_slice());
        let header = reader.headers().expect("a header").clone();
        assert_eq!(header.len(), COLUMNS.len());
        let records: Vec<csv::StringRecord> = reader.records().map(|record| record.expect("a record")).collect();
        let cell = |row: usize, name: &str| {
            let index = header.iter().position(|column| column == name).expect("a column");
            records[row][index].to_owned()
        };
        assert_eq!(
            (cell(0, "largest_m"), cell(0, "median_us"), cell(0, "cache")),
            ("0.125".into(), "2.0".into(), "warm".into())
        );
        assert_eq!((cell(1, "variant"), cell(1, "faults")), ("odd, \"name\"".into(), "one; two, three".into()));
        assert_eq!((cell(0, "bias_y_m"), cell(0, "largest_px")), ("-0.5".into(), String::new()));
        assert_eq!(cell(0, "bytes_by_formula"), "U: 4 x sum 3 n r = 2000");
    }

    #[test]
    fn every_column_pointer_resolves_in_a_full_row() {
        let mut full = row("a", "x", CacheState::Warm, (2.0, 0.125)).relative_to(MemoryBandwidth {
            copy_gbs: Some(1.0),
            read_gbs: Some(1.0),
            ..MemoryBandwidth::default()
        });
        let validation = full.validation.as_mut().expect("expected a validation result");
        let norms = Some(ErrorNorms::default());
        validation.errors.pixels = norms;
        validation.orientation = OrientationErrors {
            normals_degrees: norms,
            normals_to_surface_degrees: norms,
            tangents_degrees: norms,
            normal_dot_tangent: norms,
            invalid_directions: 0,
        };
        let value = serde_json::to_value(&full).expect("JSON");
        for (name, pointer) in COLUMNS.iter().filter(|(_, pointer)| !pointer.is_empty()) {
            assert!(value.pointer(pointer).is_some_and(|value| !value.is_null()), "{name}");
        }
    }
}
