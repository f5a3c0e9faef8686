//! Output files of a report: JSON, CSV, Markdown, and the plot as SVG and PNG.

use std::path::Path;

use super::afternoon::AfternoonComparison;
use super::contention::{ContentionResult, Waits};
use super::delay::DelayResult;
use super::latency::LatencyResult;
use super::peers::socket::SocketComparison;
use super::picture_encodings::PictureEncodingRow;
use super::plants::{PlantCounts, PlantRates};
use super::rates::RateResult;
use super::vertex_encodings::VertexEncodingRow;
use super::{CaseReport, CaseResult, StreamReport, markdown, plot};
use crate::csv_table;
use crate::output_files::write_files;
use crate::plot::render_png;
use modalcast_model::error::{Result, fault_in};

/// Columns of `report.csv`. Every number of a case has a row of its own, with all data that describe the case.
const COLUMNS: [&str; 14] = [
    "case",
    "variant",
    "quantity",
    "value",
    "unit",
    "scene",
    "look",
    "samples",
    "shadow_map",
    "server",
    "machine",
    "date",
    "build",
    "command",
];

/// One number of a case.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Quantity {
    /// The encoding, stage or other variant that the number belongs to; empty for a case without variants.
    pub(super) variant: String,
    pub(super) name: &'static str,
    pub(super) value: f64,
    pub(super) unit: &'static str,
}

fn quantity(name: &'static str, value: f64, unit: &'static str) -> Quantity {
    Quantity { variant: String::new(), name, value, unit }
}

/// The quantities, labeled as those of a variant.
fn of_variant(variant: &str, quantities: impl IntoIterator<Item = Quantity>) -> Vec<Quantity> {
    quantities.into_iter().map(|quantity| Quantity { variant: variant.to_owned(), ..quantity }).collect()
}

impl StreamReport {
    /// Writes `report.json`, `report.csv`, `report.md`, `report.svg` and `report.png` into a folder, which is created.
    ///
    /// # Errors
    /// `Fault` when a file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<()> {
        let svg = plot::draw_svg(self);
        let files = [
            ("report.json", serde_json::to_vec_pretty(self).map_err(fault_in("report"))?),
            ("report.csv", csv(&self.cases)?),
            ("report.md", markdown::markdown(self).into_bytes()),
            ("report.png", render_png(&svg)?),
            ("report.svg", svg.into_bytes()),
        ];
        write_files(folder, files)
    }
}

fn csv(cases: &[CaseReport]) -> Result<Vec<u8>> {
    let quantities = |case: &CaseReport| case.result.quantities();
    let lines = cases.iter().flat_map(|case| quantities(case).into_iter().map(move |entry| csv_record(case, &entry)));
    csv_table::encode(COLUMNS.map(String::from), lines)
}

fn csv_record(case: &CaseReport, quantity: &Quantity) -> [String; COLUMNS.len()] {
    let look = case.look.as_ref();
    [
        case.name.to_owned(),
        quantity.variant.clone(),
        quantity.name.to_owned(),
        quantity.value.to_string(),
        quantity.unit.to_owned(),
        case.scene.to_owned(),
        look.map_or_else(String::new, super::SceneLook::line),
        look.map_or_else(String::new, |look| look.samples.to_string()),
        look.and_then(|look| look.shadow_map).map_or_else(String::new, |side| side.to_string()),
        case.server.clone(),
        case.machine.clone(),
        case.date.clone(),
        case.build.to_owned(),
        case.command.clone(),
    ]
}

impl CaseResult {
    /// All numbers of the result.
    pub(super) fn quantities(&self) -> Vec<Quantity> {
        match self {
            Self::Rate(result) => rate_quantities(result),
            Self::Latency(result) => latency_quantities(result),
            Self::Socket(result) => socket_quantities(result),
            Self::Contention(result) => contention_quantities(result),
            Self::Delay(result) => delay_quantities(result),
            Self::VertexEncodings(rows) => rows.iter().flat_map(vertex_quantities).collect(),
            Self::PictureEncodings(rows) => rows.iter().flat_map(picture_quantities).collect(),
            Self::Afternoon(comparison) => afternoon_quantities(comparison),
            Self::Plant(plant) => plant_quantities(plant),
        }
    }
}

fn plant_quantities(plant: &PlantRates) -> Vec<Quantity> {
    let PlantCounts { vertices, triangles, domains, deformable, modes, rows } = plant.counts;
    let mut quantities = rate_quantities(&plant.rate);
    quantities.extend([
        quantity("rate of recorded steps", plant.recorded_per_second, "1/s"),
        quantity("vertices", vertices as f64, "1"),
        quantity("triangles", triangles as f64, "1"),
        quantity("domains", domains as f64, "1"),
        quantity("domains with modes", deformable as f64, "1"),
        quantity("modes", modes as f64, "1"),
        quantity("rows of U", rows as f64, "1"),
    ]);
    quantities
}

fn rate_quantities(result: &RateResult) -> Vec<Quantity> {
    let mut quantities = vec![
        quantity("rate", result.per_second, "1/s"),
        quantity("steps", result.steps as f64, "1"),
        quantity("viewers", result.viewers as f64, "1"),
        quantity("views", result.views as f64, "1"),
        quantity("rate of the physics process in this run", result.steps_per_second, "1/s"),
        quantity("skipped steps", result.skipped as f64, "1"),
        quantity("rate / rate of the slowest stage", result.of_slowest_stage, "1"),
    ];
    quantities.extend(result.reply_bytes.map(|bytes| quantity("reply", bytes, "B")));
    quantities.extend(result.runs.iter().map(|rate| quantity("rate of one run", *rate, "1/s")));
    for (view, stages) in result.stages_ms.iter().enumerate() {
        for (stage, ms) in stages {
            let variant = format!("view {view}: {stage}");
            quantities.extend(of_variant(&variant, [quantity("median time", f64::from(*ms), "ms")]));
        }
    }
    for rate in &result.stage_rates {
        let numbers = [quantity("stage time", rate.ms, "ms"), quantity("stage rate", rate.per_second, "1/s")];
        quantities.extend(of_variant(&format!("{} of {}", rate.stages, rate.resource), numbers));
    }
    quantities
}

fn latency_quantities(result: &LatencyResult) -> Vec<Quantity> {
    let mut quantities = vec![
        quantity("p50", result.p50_ms, "ms"),
        quantity("p90", result.p90_ms, "ms"),
        quantity("p99", result.p99_ms, "ms"),
        quantity("max", result.max_ms, "ms"),
        quantity("delayed steps", result.delayed_steps as f64, "1"),
    ];
    quantities = of_variant(&format!("{} to {}", result.from, result.to), quantities);
    quantities.push(quantity("steps", result.steps as f64, "1"));
    quantities.extend(result.period_ms.map(|ms| quantity("period", ms, "ms")));
    quantities.extend(result.steps_per_second.map(|rate| quantity("rate of steps from memory", rate, "1/s")));
    for stage in &result.stages {
        let times = [quantity("p50", stage.p50_ms, "ms"), quantity("p99", stage.p99_ms, "ms")];
        quantities.extend(of_variant(&stage.stage, times));
    }
    quantities
}

fn socket_quantities(result: &SocketComparison) -> Vec<Quantity> {
    vec![
        quantity("reply", result.reply_bytes as f64, "B"),
        quantity("chunk", result.chunk_bytes as f64, "B"),
        quantity("replies", result.replies as f64, "1"),
        quantity("rate of the stream", result.stream_per_second, "1/s"),
        quantity("rate of single requests", result.request_per_second, "1/s"),
        quantity("rate of the stream over a Unix socket", result.unix_stream_per_second, "1/s"),
        quantity("rate of single requests over a Unix socket", result.unix_request_per_second, "1/s"),
        quantity("rate of the stream in shared memory", result.shared_stream_per_second, "1/s"),
        quantity("rate of single requests in shared memory", result.shared_request_per_second, "1/s"),
        quantity("rate of the socket", result.socket_per_second, "1/s"),
        quantity("stream / socket", result.stream_of_socket, "1"),
        quantity("single requests / socket", result.request_of_socket, "1"),
        quantity("bandwidth of the stream", result.stream_bytes_per_second, "B/s"),
        quantity("bandwidth of the socket", result.socket_bytes_per_second, "B/s"),
    ]
}

fn contention_quantities(result: &ContentionResult) -> Vec<Quantity> {
    let of_waits = |variant: &str, waits: &Waits| {
        let quantities = [
            quantity("steps", waits.steps as f64, "1"),
            quantity("p50", waits.p50_ms, "ms"),
            quantity("p99", waits.p99_ms, "ms"),
            quantity("max", waits.max_ms, "ms"),
        ];
        of_variant(variant, quantities)
    };
    let mut quantities = vec![
        quantity("period", result.period_ms, "ms"),
        quantity("added p99", result.added_p99_ms, "ms"),
        quantity("added max", result.added_max_ms, "ms"),
    ];
    quantities.extend(of_waits("idle", &result.idle));
    quantities.extend(of_waits("busy", &result.busy));
    for job in &result.jobs {
        quantities.extend(of_variant(&job.job, [quantity("time of the job", job.job_ms, "ms")]));
        quantities.extend(of_waits(&job.job, &job.waits));
    }
    quantities
}

fn delay_quantities(result: &DelayResult) -> Vec<Quantity> {
    vec![
        quantity("round trip", result.round_trip_ms as f64, "ms"),
        quantity("steps", result.steps as f64, "1"),
        quantity("bytes per step", result.bytes, "B"),
        quantity("rate without a proxy", result.direct_per_second, "1/s"),
        quantity("rate through a proxy without delay", result.undelayed_per_second, "1/s"),
        quantity("rate with delay", result.delayed_per_second, "1/s"),
        quantity("rate with delay / without", result.of_undelayed, "1"),
    ]
}

fn afternoon_quantities(comparison: &AfternoonComparison) -> Vec<Quantity> {
    let of_program = comparison.variants.iter().flat_map(|variant| {
        let numbers = [
            quantity("rate of the program", variant.per_second, "1/s"),
            quantity("reply of the program", variant.bytes, "B"),
            quantity("rate of the server", variant.server_per_second, "1/s"),
            quantity("reply of the server", variant.server_bytes, "B"),
            quantity("server / program", variant.server_of_program, "1"),
        ];
        of_variant(&variant.name, numbers)
    });
    of_program.chain([quantity("server / best PNG variant", comparison.of_best_png, "1")]).collect()
}

fn vertex_quantities(row: &VertexEncodingRow) -> Vec<Quantity> {
    let unit = row.error_unit();
    let numbers = [
        quantity("bytes", row.bytes as f64, "B"),
        quantity("time to pack", row.pack_ms, "ms"),
        quantity("time to decode", row.decode_ms, "ms"),
        quantity("largest error", row.errors.largest, unit),
        quantity("rms error", row.errors.rms, unit),
        quantity("largest bound", row.errors.bound, unit),
        quantity("largest error / bound", row.errors.of_bound, "1"),
    ];
    of_variant(&format!("{} {}", row.attribute, row.encoding), numbers)
}

fn picture_quantities(row: &PictureEncodingRow) -> Vec<Quantity> {
    let numbers = [
        quantity("bytes", row.bytes as f64, "B"),
        quantity("time to encode", row.ms, "ms"),
        quantity("largest error", row.largest_error, "level"),
        quantity("rms error", row.rms_error, "level"),
    ];
    let parallel = row.all_threads_ms.map(|ms| quantity("time to encode on all threads", ms, "ms"));
    of_variant(&row.encoder, numbers.into_iter().chain(parallel))
}
