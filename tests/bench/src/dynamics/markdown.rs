//! Formats a report as Markdown (`report.md`).

use super::oscillators::{PERIODS, SINGLE_MODES, STIFF_SYSTEM};
use super::plants::PlantRow;
use super::recommendation::format_step;
use super::row::{IntegrationRow, larger};
use super::solid_modes::SolidRow;
use super::{DynamicsReport, beam, cubic, extremes};
use crate::markdown_table::{dash, table};

/// How the numbers are defined.
const NOTE: &str = "Displacement errors are the largest ones of all sample times, relative to the largest displacement of \
the reference; energy errors are relative to the energy at the start. `order` is observed between this step and the next \
larger one, `theory` is the order of the method. Times are those of one thread by the wall clock (solids: all cores), the \
median of up to 20 runs. AVF is the average vector field method. A tolerance is that of the estimated error of a step, in \
diagonals. `limited` counts steps whose estimated error exceeds the tolerance with 64 sub-steps.";

/// The complete report.
pub(super) fn markdown(report: &DynamicsReport) -> String {
    let commit = report.provenance.commit.as_deref().unwrap_or("unknown");
    let (machine, command) = (report.provenance.line(), report.provenance.command.join(" "));
    let mut text = format!(
        "# Time integrators and computed modes\n\n{machine}\n\nCommit {commit}. Command: `{command}`\n\n{NOTE}\n"
    );
    text.extend(report.remarks.iter().map(|remark| format!("\n{remark}\n")));
    if !report.missing.is_empty() {
        text.push_str(&format!("\nNot measured yet: {}.\n", report.missing.join(", ")));
    }
    text.push_str(&match report.failed.is_empty() {
        true => "\nAll expectations are met.\n".to_owned(),
        false => format!("\nFailed:\n\n- {}\n", report.failed.join("\n- ")),
    });
    let of_case = |case| report.rows.iter().filter(|row| row.case == case).collect::<Vec<_>>();
    text.push_str(&single_modes_section(&of_case(SINGLE_MODES)));
    text.push_str(&stiff_section(&of_case(STIFF_SYSTEM)));
    text.push_str(&beam_section(&of_case(beam::CASE)));
    for case in [cubic::CHAIN, cubic::BRIDGE] {
        text.push_str(&cubic_section(report, &of_case(case)));
    }
    text.push_str(&extremes_section(&of_case(extremes::CASE)));
    text.push_str(&solids_section(&report.solids));
    text.push_str(&plants_section(&report.plants));
    text.push_str(&recommendation_section(report));
    text
}

fn format_error(error: Option<f64>) -> String {
    error.map_or_else(dash, |error| format!("{error:.1e}"))
}

fn format_decimal(value: Option<f64>) -> String {
    value.map_or_else(dash, |value| format!("{value:.2}"))
}

fn format_theory(row: &IntegrationRow) -> String {
    row.theoretical_order.map_or_else(dash, |order| format!("{order:.0}"))
}

fn format_step_us(row: &IntegrationRow) -> String {
    format_decimal(row.timing.map(|timing| timing.median_us))
}

/// The distinct values of rows, in their order.
fn distinct<T: PartialEq>(values: impl Iterator<Item = T>) -> Vec<T> {
    let mut list = Vec::new();
    for value in values {
        if !list.contains(&value) {
            list.push(value);
        }
    }
    list
}

/// The largest number of several; `None` if one is missing.
fn largest(mut numbers: impl Iterator<Item = Option<f64>>) -> Option<f64> {
    numbers.try_fold(0.0, |largest, number| Some(larger(largest, number?)))
}

fn single_modes_section(rows: &[&IntegrationRow]) -> String {
    if rows.is_empty() {
        return String::new();
    }
    let mut text = format!(
        "\n## Linear modes alone\n\nA mode is released at q = 1 and moves for {PERIODS} periods. Largest values of modes of \
         1 mHz, 1 Hz, 1 kHz and 1 MHz. Displacement errors are distances of (q, v / omega). The order is that of 1 Hz.\n"
    );
    let damping = |row: &IntegrationRow| row.system.split_once(", ").map_or("", |(_, damping)| damping).to_owned();
    let steps_per_period = |row: &IntegrationRow| row.steps / PERIODS;
    let head = ["method", "steps per period", "displacement", "phase, rad", "energy", "order", "theory", "µs per step"];
    for damping_name in distinct(rows.iter().map(|row| damping(row))) {
        let rows: Vec<&IntegrationRow> = rows.iter().copied().filter(|row| damping(row) == damping_name).collect();
        let settings = distinct(rows.iter().map(|row| (row.method.clone(), steps_per_period(row))));
        let lines = settings.iter().map(|(method, steps)| {
            let group: Vec<&IntegrationRow> =
                rows.iter().copied().filter(|row| row.method == *method && steps_per_period(row) == *steps).collect();
            let hertz = group.iter().find(|row| row.system.starts_with("1 Hz"));
            let error =
                |of: &dyn Fn(&IntegrationRow) -> Option<f64>| format_error(largest(group.iter().map(|row| of(row))));
            [
                method.clone(),
                steps.to_string(),
                error(&|row| Some(row.errors?.displacement)),
                error(&|row| row.errors?.phase_radians),
                error(&|row| row.errors?.energy),
                format_decimal(hertz.and_then(|row| row.observed_order)),
                group.first().map_or_else(dash, |row| format_theory(row)),
                format_decimal(largest(group.iter().map(|row| Some(row.timing?.median_us)))),
            ]
        });
        text.push_str(&format!("\n### {damping_name}\n\n{}", table(&head, lines)));
    }
    text
}

fn stiff_section(rows: &[&IntegrationRow]) -> String {
    if rows.is_empty() {
        return String::new();
    }
    let mut text =
        "\n## Ten modes in one system\n\nAll modes are released at q = 1 and move for 10 s. Displacement errors \
                    by mode; in the last line, the time of a step of the system.\n"
            .to_owned();
    let damping = |row: &IntegrationRow| row.system.rsplit_once(", ").map_or("", |(_, damping)| damping).to_owned();
    let methods = distinct(rows.iter().map(|row| row.method.clone()));
    let head: Vec<&str> = ["mode"].into_iter().chain(methods.iter().map(String::as_str)).collect();
    for (damping_name, dt) in distinct(rows.iter().map(|row| (damping(row), row.dt_seconds))) {
        let rows: Vec<&IntegrationRow> =
            rows.iter().copied().filter(|row| damping(row) == damping_name && row.dt_seconds == dt).collect();
        let modes = distinct(rows.iter().map(|row| row.system.clone()));
        let line = |first: String, mode: &String, cell: &dyn Fn(&IntegrationRow) -> String| {
            let of_method = |method: &String| rows.iter().find(|row| row.system == *mode && row.method == *method);
            let cells = methods.iter().map(|method| of_method(method).map_or_else(dash, |row| cell(row)));
            [first].into_iter().chain(cells.collect::<Vec<_>>()).collect::<Vec<String>>()
        };
        let mode_name = |mode: &String| mode.split(" of ").next().unwrap_or_default().to_owned();
        let error = |row: &IntegrationRow| format_error(row.errors.map(|errors| errors.displacement));
        let mut lines: Vec<Vec<String>> = modes.iter().map(|mode| line(mode_name(mode), mode, &error)).collect();
        lines.extend(modes.first().map(|mode| line("µs per step".into(), mode, &|row| format_step_us(row))));
        let seconds = rows.first().map_or(0.0, |row| row.duration());
        let heading = format!("{damping_name}, steps of {}, {seconds:.0} s", format_step(dt));
        text.push_str(&format!("\n### {heading}\n\n{}", table(&head, lines)));
    }
    text
}

fn beam_section(rows: &[&IntegrationRow]) -> String {
    if rows.is_empty() {
        return String::new();
    }
    let head = [
        "modes",
        "method",
        "step",
        "time error",
        "order",
        "theory",
        "truncation error",
        "total error",
        "µs per step",
        "ms per second",
    ];
    let line = |row: &&IntegrationRow| {
        [
            row.coordinates.to_string(),
            row.method.clone(),
            format_step(row.dt_seconds),
            format_error(row.errors.map(|errors| errors.displacement)),
            format_decimal(row.observed_order),
            format_theory(row),
            format_error(row.errors.and_then(|errors| errors.truncation)),
            format_error(row.errors.and_then(|errors| errors.total)),
            format_step_us(row),
            format_decimal(row.ms_per_second()),
        ]
    };
    format!("\n## Beam\n\n{}.\n\n{}", beam::DESCRIPTION, table(&head, rows.iter().map(line)))
}

fn cubic_section(report: &DynamicsReport, rows: &[&IntegrationRow]) -> String {
    let Some(first) = rows.first() else { return String::new() };
    let reference = report.references.iter().find(|reference| reference.case == first.case);
    let reference = reference.map_or_else(String::new, |reference| {
        format!(
            " Reference: Runge-Kutta method of fourth order, steps of {:.2e} s; the last halving of the step changed \
             displacements by {:.1e}.",
            reference.dt_seconds, reference.change_by_halving
        )
    });
    let head = [
        "method",
        "step",
        "mean sub-step",
        "displacement",
        "energy",
        "order",
        "theory",
        "rejections",
        "limited",
        "µs per step",
        "ms per second",
    ];
    let line = |row: &&IntegrationRow| {
        [
            row.method.clone(),
            format_step(row.dt_seconds),
            format!("{:.1e} s", row.mean_sub_step()),
            format_error(row.errors.map(|errors| errors.displacement)),
            format_error(row.errors.and_then(|errors| errors.energy)),
            format_decimal(row.observed_order),
            format_theory(row),
            row.work.map_or_else(dash, |work| work.rejections.to_string()),
            row.work.map_or_else(dash, |work| work.limited_steps.to_string()),
            format_step_us(row),
            format_decimal(row.ms_per_second()),
        ]
    };
    format!(
        "\n## Cubic forces: {}\n\n{}, released from a deflection; {:.0} s.{reference} The exact integrator of the linear \
         modes ignores the cubic forces: it is the negative control.\n\n{}",
        first.case,
        first.system,
        first.duration(),
        table(&head, rows.iter().map(line))
    )
}

fn extremes_section(rows: &[&IntegrationRow]) -> String {
    if rows.is_empty() {
        return String::new();
    }
    let head = [
        "system",
        "method",
        "step",
        "steps",
        "displacement",
        "energy",
        "most sub-steps",
        "limited",
        "µs per step",
        "error",
    ];
    let line = |row: &&IntegrationRow| {
        [
            row.system.clone(),
            row.method.clone(),
            format_step(row.dt_seconds),
            row.steps.to_string(),
            format_error(row.errors.map(|errors| errors.displacement)),
            format_error(row.errors.and_then(|errors| errors.energy)),
            row.work.map_or_else(dash, |work| work.max_sub_steps.to_string()),
            row.work.map_or_else(dash, |work| work.limited_steps.to_string()),
            format_step_us(row),
            row.failure.clone().unwrap_or_default(),
        ]
    };
    format!("\n## Extreme cases\n\n{}", table(&head, rows.iter().map(line)))
}

fn solids_section(rows: &[SolidRow]) -> String {
    if rows.is_empty() {
        return String::new();
    }
    let head = [
        "solid",
        "triangles",
        "--freedoms",
        "freedoms",
        "worst of 20 frequencies",
        "mean",
        "estimated",
        "seconds",
        "peak memory, MB",
        "error",
    ];
    let line = |row: &SolidRow| {
        [
            row.solid.to_owned(),
            row.triangles.to_string(),
            row.freedom_limit.to_string(),
            row.freedoms.to_string(),
            format_error(row.worst_error),
            format_error(row.mean_error),
            format_error(row.estimated_error),
            format_decimal(Some(row.seconds)),
            row.peak_bytes.map_or_else(dash, |bytes| format!("{:.0}", bytes as f64 / 1e6)),
            row.failure.clone().unwrap_or_default(),
        ]
    };
    format!(
        "\n## Modes of solids\n\nFree solids, rotated against the grid. The references are Rayleigh-Ritz solutions with \
         polynomials. The memory is that of the whole process.\n\n{}",
        table(&head, rows.iter().map(line))
    )
}

fn plants_section(rows: &[PlantRow]) -> String {
    let Some(smallest) = rows.first() else { return String::new() };
    let head = [
        "plant",
        "domains",
        "coordinates",
        "µs per step",
        "CPU µs per step",
        "CPU µs per step and domain",
        "relative",
        "steps/s",
        "load average",
    ];
    let line = |row: &PlantRow| {
        [
            row.plant.clone(),
            row.domains.to_string(),
            row.coordinates.to_string(),
            format!("{:.0}", row.step_us),
            format!("{:.0}", row.step_cpu_us),
            format_decimal(Some(row.domain_cpu_us())),
            format_decimal(Some(row.domain_cpu_us() / smallest.domain_cpu_us())),
            format!("{:.0}", 1e6 / row.step_us),
            format_decimal(row.load_average),
        ]
    };
    format!(
        "\n## Plants\n\nA step of the physics process in the wind, without a server: wind, motion, transforms, and the \
         largest values of the run. CPU times are those of all threads together.\n\n{}",
        table(&head, rows.iter().map(line))
    )
}

fn recommendation_section(report: &DynamicsReport) -> String {
    if report.recommendations.is_empty() {
        return String::new();
    }
    let head = ["system", "error at most", "setting", "ms", "per", "error", "equally fast within noise"];
    let lines = report.recommendations.iter().map(|recommendation| {
        [
            recommendation.system.to_owned(),
            format!("{:.0e}", recommendation.limit),
            recommendation.setting.clone(),
            format!("{:.3}", recommendation.milliseconds),
            recommendation.unit.to_owned(),
            format_error(Some(recommendation.error)),
            recommendation.equally_fast.join("; "),
        ]
    });
    format!(
        "\n## Recommendation\n\nFor each limit of the relative error, the fastest setting. A limit that is not listed has the \
         setting of the next smaller one.\n\n{}",
        table(&head, lines)
    )
}
