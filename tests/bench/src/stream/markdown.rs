//! Formats a report as Markdown (`report.md`): one table for each kind of measurement.

use super::afternoon::AfternoonComparison;
use super::contention::{ContentionResult, Waits};
use super::delay::DelayResult;
use super::latency::LatencyResult;
use super::peers::socket::SocketComparison;
use super::picture_encodings::PictureEncodingRow;
use super::rates::RateResult;
use super::vertex_encodings::VertexEncodingRow;
use super::{CaseReport, CaseResult, StreamReport, plants};
use crate::markdown_table::{dash, table};

/// How a rate and the rates of the stages are defined.
const RATE_NOTE: &str = "The server, the physics process and each viewer are separate processes of this machine. A viewer \
that receives n replies in a time t, from the first to the last reply, has the rate (n - 1) / t. The rate of a run is the \
rate of its slowest viewer. In a run without viewers, it is the rate of the physics process from the first step sent to \
the last acknowledgment. The rate of a case is the median of its runs. All streams are lossless.

The rate of a stage alone is the number of threads that run it in parallel, divided by its median time per step: \
for pictures in a run with one step in flight, otherwise in the same run. Drawing and encoding times are summed over the \
distinct views. `deform`, `upload`, `switch`, `shadow` and `draw` run one after the other on one device and count as one \
stage. The rate of the physics process alone is measured with a server that merges steps. The transfer alone is a plain \
TCP connection over loopback with replies of the same size.";

/// The complete report.
pub(super) fn markdown(report: &StreamReport) -> String {
    let commit = report.provenance.commit.as_deref().unwrap_or("unknown");
    let mut text = format!(
        "# Rates and latencies at the client\n\n{}\n\nCommit {commit}, build {}. Command: `{}`\n",
        report.provenance.line(),
        report.build,
        report.provenance.command.join(" ")
    );
    if !report.is_full_size {
        text.push_str("\nQuick report: pictures have a quarter of the width and height that their case names.\n");
    }
    if !report.missing.is_empty() {
        text.push_str(&format!("\nNot measured yet: {}.\n", report.missing.join(", ")));
    }
    if !report.failed.is_empty() {
        text.push_str(&format!("\nFailed:\n\n- {}\n", report.failed.join("\n- ")));
    }
    text.push_str(&rate_section(report));
    let plant_rows = plants::table_rows(report);
    text.push_str(&section("Plants: tables 4.5 to 4.7 of the thesis", plants::NOTE, &plants::HEADER, plant_rows));
    text.push_str(&latency_section(report));
    text.push_str(&socket_section(report));
    text.push_str(&contention_section(report));
    text.push_str(&delay_section(report));
    text.push_str(&afternoon_section(report));
    text.push_str(&encoding_sections(report));
    text.push_str(&scene_section(report));
    text
}

/// The cases whose result `select` returns.
fn select<'a, T>(report: &'a StreamReport, select: impl Fn(&'a CaseResult) -> Option<T>) -> Vec<(&'a CaseReport, T)> {
    report.cases.iter().filter_map(|case| Some((case, select(&case.result)?))).collect()
}

/// A section with a table; empty without rows.
fn section(title: &str, note: &str, head: &[&str], rows: Vec<Vec<String>>) -> String {
    match rows.is_empty() {
        true => String::new(),
        false => format!("\n## {title}\n\n{note}\n\n{}", table(head, rows)),
    }
}

fn rate_section(report: &StreamReport) -> String {
    let rates = select(report, CaseResult::rate);
    let row = |(case, result): &(&CaseReport, &RateResult)| {
        let slowest = result.stage_rates.first();
        let runs: Vec<String> = result.runs.iter().map(|rate| format!("{rate:.1}")).collect();
        vec![
            case.name.to_owned(),
            result.content.clone().unwrap_or_else(dash),
            format!("{} / {}", result.viewers, result.views),
            format!("{:.1}", result.per_second),
            runs.join(", "),
            result.reply_bytes.map_or_else(dash, |bytes| format!("{bytes:.0}")),
            slowest.map_or_else(dash, super::stages::StageRate::line),
            slowest.map_or_else(dash, |rate| format!("{:.1}", rate.per_second)),
            format!("{:.2}", result.of_slowest_stage),
        ]
    };
    let head = [
        "case",
        "content",
        "viewers / views",
        "per second",
        "runs",
        "bytes",
        "slowest stage",
        "rate of this stage alone",
        "rate / rate of this stage",
    ];
    let text = section("Rates", RATE_NOTE, &head, rates.iter().map(row).collect());
    let stage_rows = rates.iter().flat_map(|(case, result)| {
        result.stage_rates.iter().map(|rate| {
            vec![case.name.to_owned(), rate.line(), rate.parallel.to_string(), format!("{:.1}", rate.per_second)]
        })
    });
    let stage_head = ["case", "stage: time per step", "in parallel", "per second alone"];
    text + &section("Rates of the stages", "The slowest stage of a case is first.", &stage_head, stage_rows.collect())
}

fn latency_section(report: &StreamReport) -> String {
    let latencies = select(report, |result| match result {
        CaseResult::Latency(result) => Some(result),
        _ => None,
    });
    let row = |(case, result): &(&CaseReport, &LatencyResult)| {
        let mut cells = vec![case.name.to_owned(), format!("{} to {}", result.from, result.to)];
        cells.extend([result.p50_ms, result.p90_ms, result.p99_ms, result.max_ms].map(|ms| format!("{ms:.3}")));
        cells.push(result.steps.to_string());
        cells.push(result.period_ms.map_or_else(dash, |ms| format!("{ms:.1}")));
        cells.push(result.delayed_steps.to_string());
        cells.push(result.steps_per_second.map_or_else(dash, |rate| format!("{rate:.1}")));
        cells
    };
    let head = [
        "case",
        "time",
        "p50 ms",
        "p90 ms",
        "p99 ms",
        "max ms",
        "steps",
        "period ms",
        "delayed",
        "steps/s from memory",
    ];
    let note = "One step is in flight. Sender and viewer are two connections of one process. A step is delayed if the \
                previous one had not arrived when it was due. Steps from memory were recorded before, so that their \
                rate includes no physics.";
    let text = section("Latency", note, &head, latencies.iter().map(row).collect());
    let stage_rows = latencies.iter().flat_map(|(case, result)| {
        result.stages.iter().map(|stage| {
            let times = [stage.p50_ms, stage.p99_ms].map(|ms| format!("{ms:.3}"));
            [case.name.to_owned(), stage.stage.clone()].into_iter().chain(times).collect()
        })
    });
    let bottleneck =
        |(case, result): &(&CaseReport, &LatencyResult)| Some(format!("{}: {}.", case.name, result.bottleneck()?));
    let bottlenecks: Vec<String> = latencies.iter().filter_map(bottleneck).collect();
    let note = format!("The longest part of each case: {}", bottlenecks.join(" "));
    text + &section("Latency of the stages", &note, &["case", "stage", "p50 ms", "p99 ms"], stage_rows.collect())
}

fn socket_section(report: &StreamReport) -> String {
    let comparisons = select(report, |result| match result {
        CaseResult::Socket(result) => Some(result),
        _ => None,
    });
    let row = |(case, result): &(&CaseReport, &SocketComparison)| {
        vec![
            case.name.to_owned(),
            result.reply_bytes.to_string(),
            result.replies.to_string(),
            format!("{:.1}", result.stream_per_second),
            format!("{:.1}", result.request_per_second),
            format!("{:.1}", result.unix_stream_per_second),
            format!("{:.1}", result.unix_request_per_second),
            format!("{:.1}", result.shared_stream_per_second),
            format!("{:.1}", result.shared_request_per_second),
            format!("{:.1}", result.socket_per_second),
            format!("{:.3}", result.stream_of_socket),
            format!("{:.3}", result.request_of_socket),
            format!("{:.2}", result.socket_bytes_per_second / 1e9),
        ]
    };
    let head = [
        "case",
        "bytes",
        "replies",
        "stream /s",
        "requests /s",
        "stream, Unix /s",
        "requests, Unix /s",
        "stream, shared /s",
        "requests, shared /s",
        "socket /s",
        "stream / socket",
        "requests / socket",
        "socket GB/s",
    ];
    let note = "Positions as f32 beside a plain TCP connection over loopback that carries as many bytes in chunks of 1 MiB \
                between two processes. The receiver of the plain connection reads into one buffer and does not decode. \
                Steps are sent from memory. Single requests ask for the same step again and again. `Unix` is a Unix \
                socket in place of TCP, and `shared` is shared memory.";
    section("Vertices and a plain socket", note, &head, comparisons.iter().map(row).collect())
}

fn contention_section(report: &StreamReport) -> String {
    let contentions = select(report, |result| match result {
        CaseResult::Contention(result) => Some(result),
        _ => None,
    });
    let rows_of = |(case, result): &(&CaseReport, &ContentionResult)| {
        let row = |job: &str, job_ms: Option<f64>, waits: &Waits| {
            let mut cells =
                vec![case.name.to_owned(), job.to_owned(), job_ms.map_or_else(dash, |ms| format!("{ms:.0}"))];
            cells.push(waits.steps.to_string());
            cells.extend([waits.p50_ms, waits.p99_ms, waits.max_ms].map(|ms| format!("{ms:.2}")));
            cells.extend([waits.p99_ms, waits.max_ms].map(|ms| format!("{:.2}", ms - result.idle.p50_ms)));
            let stages = waits.longest_stages.iter().take(2).map(|(stage, ms)| format!("{stage} {ms:.1}"));
            cells.push(stages.collect::<Vec<_>>().join(", "));
            cells
        };
        let mut rows = vec![row("none", None, &result.idle), row("all", None, &result.busy)];
        rows.extend(result.jobs.iter().map(|job| row(&job.job, Some(job.job_ms), &job.waits)));
        rows
    };
    let head = [
        "case",
        "job",
        "its time ms",
        "steps",
        "p50 ms",
        "p99 ms",
        "max ms",
        "added p99 ms",
        "added max ms",
        "longest stages of the step with the max",
    ];
    let note = "A client sends a step of the tree each period and receives a frame of 320x180 of it, while the server \
                does a job for another client. A wait counts from the time at which the step was due. The added wait is \
                the difference to the median without a job. The first round of a load also compiles programs.";
    section("Waits for another client", note, &head, contentions.iter().flat_map(rows_of).collect())
}

fn delay_section(report: &StreamReport) -> String {
    let delays = select(report, |result| match result {
        CaseResult::Delay(result) => Some(result),
        _ => None,
    });
    let row = |(case, result): &(&CaseReport, &DelayResult)| {
        vec![
            case.name.to_owned(),
            result.content.clone(),
            format!("{:.0}", result.bytes),
            format!("{:.1}", result.direct_per_second),
            format!("{:.1}", result.undelayed_per_second),
            format!("{:.1}", result.delayed_per_second),
            format!("{:.2}", result.of_undelayed),
        ]
    };
    let head = ["case", "content", "bytes", "direct /s", "proxy, 0 ms /s", "proxy, 50 ms /s", "50 ms / 0 ms"];
    let note = "A proxy in its own process delays each direction by 25 ms and does not limit the rate otherwise.";
    section("Round trip of 50 ms", note, &head, delays.iter().map(row).collect())
}

fn afternoon_section(report: &StreamReport) -> String {
    let comparisons = select(report, |result| match result {
        CaseResult::Afternoon(comparison) => Some(comparison),
        _ => None,
    });
    let rows = comparisons.iter().flat_map(|(case, comparison): &(&CaseReport, &AfternoonComparison)| {
        comparison.variants.iter().map(|variant| {
            vec![
                case.name.to_owned(),
                variant.name.clone(),
                format!("{:.1}", variant.per_second),
                format!("{:.0}", variant.bytes),
                variant.server_content.clone(),
                format!("{:.1}", variant.server_per_second),
                format!("{:.0}", variant.server_bytes),
                format!("{:.2}", variant.server_of_program),
                format!("{}, {}", comparison.arrays, comparison.renderer),
            ]
        })
    });
    let head = [
        "case",
        "program",
        "per second",
        "bytes",
        "server",
        "per second",
        "bytes",
        "server / program",
        "the program's arrays and renderer",
    ];
    let note = "The program is `tests/bench/peers/afternoon.py`. The pictures of the program are received by another \
                process. The program replays a recorded motion and draws without normal maps; the server is driven by a \
                physics process.";
    section("Beside a Python program", note, &head, rows.collect())
}

fn encoding_sections(report: &StreamReport) -> String {
    let vertices = select(report, |result| match result {
        CaseResult::VertexEncodings(rows) => Some(rows),
        _ => None,
    });
    let vertex_row = |case: &CaseReport, row: &VertexEncodingRow| {
        let unit = row.error_unit();
        let mut cells = vec![case.scene.to_owned(), row.attribute.to_owned(), row.encoding.to_owned()];
        cells.push(row.bytes.to_string());
        cells.extend([row.pack_ms, row.decode_ms].map(|ms| format!("{ms:.3}")));
        cells.extend([row.errors.largest, row.errors.rms, row.errors.bound].map(|error| format!("{error:.2e} {unit}")));
        cells.push(format!("{:.3}", row.errors.of_bound));
        cells
    };
    let vertex_rows = vertices.iter().flat_map(|(case, rows)| rows.iter().map(|row| vertex_row(case, row)));
    let head = [
        "scene",
        "attribute",
        "encoding",
        "bytes",
        "pack ms",
        "decode ms",
        "largest error",
        "rms error",
        "bound",
        "largest error / its bound",
    ];
    let note = "Pack: the server's stage `encode`. Decode: the time that the client's stream works on a step, which \
                assembles the chunks and decodes them to f32. Errors are relative to f32.";
    let text = section("Encodings of vertices", note, &head, vertex_rows.collect());
    let pictures = select(report, |result| match result {
        CaseResult::PictureEncodings(rows) => Some(rows),
        _ => None,
    });
    let picture_row = |case: &CaseReport, row: &PictureEncodingRow| {
        let name = if row.is_used_by_server { format!("**{}**", row.encoder) } else { row.encoder.clone() };
        let errors = [row.largest_error, row.rms_error].map(|error| format!("{error:.3}"));
        let all_threads_ms = row.all_threads_ms.map_or_else(dash, |ms| format!("{ms:.2}"));
        let cells = [case.scene.to_owned(), name, row.bytes.to_string(), format!("{:.2}", row.ms), all_threads_ms];
        cells.into_iter().chain(errors).collect()
    };
    let picture_rows = pictures.iter().flat_map(|(case, rows)| rows.iter().map(|row| picture_row(case, row)));
    let head = ["scene", "encoder", "bytes", "one thread ms", "all threads ms", "largest error", "rms error"];
    let note = "One frame. The server uses the encoders in bold. Errors are in levels of 255.";
    text + &section("Encodings of pictures", note, &head, picture_rows.collect())
}

fn scene_section(report: &StreamReport) -> String {
    let mut rows: Vec<Vec<String>> = Vec::new();
    for case in &report.cases {
        let look = case.look.as_ref();
        rows.push(vec![
            case.name.to_owned(),
            case.scene.to_owned(),
            look.map_or("not drawn".into(), super::SceneLook::line),
            look.map_or_else(dash, |look| look.samples.to_string()),
            case.server.clone(),
            case.date.clone(),
        ]);
    }
    section("Scenes and servers", "", &["case", "scene", "look", "samples", "server", "date"], rows)
}
