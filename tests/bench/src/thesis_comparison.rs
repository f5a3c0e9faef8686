//! Compares our results with the thesis: values for `report.json`, tables for `report.md`.

use serde::Serialize;

use super::table::DeformRow;
use super::thesis::{CPU_OVER_GPU, PLANTS, POWERS, RANKS, ThesisPlant};
use super::timing::CacheState;
use modalcast_model::deform::Backend;

/// One cell of table 4.4 with our result.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SingleDomainComparison {
    pub power: u32,
    pub rank: usize,
    /// Table 4.4: CPU time over GPU time.
    pub thesis: f64,
    /// Time of the fastest exact CPU variant divided by that of the fastest exact CUDA variant; `None` without both.
    pub ours: Option<f64>,
}

/// One plant of the thesis with our results.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PlantComparison {
    pub thesis: ThesisPlant,
    /// Warm medians of the variants that passed: name and milliseconds.
    pub ours: Vec<(String, f64)>,
}

/// All comparisons with the thesis.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ThesisComparison {
    pub source: &'static str,
    pub table_4_4: Vec<SingleDomainComparison>,
    pub tables_4_5_to_4_7: Vec<PlantComparison>,
}

impl ThesisComparison {
    /// Selects the rows of full-size loads; `full` returns whether a load has its full size.
    pub fn of(rows: &[DeformRow], full: impl Fn(&str) -> bool) -> Self {
        let warm = |load: &str| -> Vec<&DeformRow> {
            let fits = |row: &&DeformRow| {
                row.load == load && row.cache == CacheState::Warm && row.timing.is_some() && full(load)
            };
            rows.iter().filter(fits).collect()
        };
        let single = |(at, rank): (usize, usize), (column, power): (usize, u32)| {
            let rows = warm(&format!("single-{power}-{rank}"));
            let fastest = |backend: Backend| {
                let exact = |row: &&&DeformRow| {
                    row.backend == backend && row.storage == Default::default() && row.truncation_meters.is_none()
                };
                rows.iter().filter(exact).filter_map(|row| Some(row.timing?.median_us)).min_by(f64::total_cmp)
            };
            let ours = fastest(Backend::Cpu).zip(fastest(Backend::Cuda)).map(|(cpu, cuda)| cpu / cuda);
            SingleDomainComparison { power, rank, thesis: CPU_OVER_GPU[at][column], ours }
        };
        let ranks = RANKS.into_iter().enumerate();
        let plant = |(index, thesis): (usize, ThesisPlant)| {
            let ours = warm(&format!("plant-{}", index + 1)).into_iter();
            let ours = ours.filter_map(|row| Some((row.name.clone(), row.timing?.median_us / 1e3)));
            PlantComparison { thesis, ours: ours.collect() }
        };
        Self {
            source: "thesis, chapter 4: GeForce GTX 680; CPU with OpenMP, 16 threads",
            table_4_4: ranks
                .flat_map(|rank| POWERS.into_iter().enumerate().map(move |power| single(rank, power)))
                .collect(),
            tables_4_5_to_4_7: PLANTS.into_iter().enumerate().map(plant).collect(),
        }
    }

    /// Both tables as Markdown.
    pub fn markdown(&self) -> String {
        let mut text = format!(
            "## Beside the thesis\n\nSource: {}. Loads of reduced size leave our columns empty.\n\n",
            self.source
        );
        text.push_str("Table 4.4, CPU time over GPU time, thesis / ours:\n\n");
        let columns = POWERS.map(|power| format!("2^{power}"));
        text.push_str(&line(std::iter::once("r".to_owned()).chain(columns)));
        text.push_str(&rule(1 + POWERS.len()));
        for (at, rank) in RANKS.iter().enumerate() {
            let cells = &self.table_4_4[at * POWERS.len()..][..POWERS.len()];
            let cell = |single: &SingleDomainComparison| {
                format!("{} / {}", single.thesis, single.ours.map_or_else(dash, |ours| format!("{ours:.2}")))
            };
            text.push_str(&line(std::iter::once(rank.to_string()).chain(cells.iter().map(cell))));
        }
        let mut names: Vec<&str> = Vec::new();
        for (name, _) in self.tables_4_5_to_4_7.iter().flat_map(|plant| &plant.ours) {
            if !names.contains(&name.as_str()) {
                names.push(name);
            }
        }
        text.push_str("\nTables 4.5 to 4.7, milliseconds of the thesis, then of ours (whole vertex update):\n\n");
        let thesis = ["species", "u", "CPU t_uq", "GPU t_uq", "GPU t_vb", "kernels", "k_uq", "CPU O_uq", "GPU O_uq"];
        text.push_str(&line(thesis.iter().chain(&names).map(ToString::to_string)));
        text.push_str(&rule(thesis.len() + names.len()));
        for PlantComparison { thesis, ours } in &self.tables_4_5_to_4_7 {
            let time =
                |name: &&str| ours.iter().find(|(own, _)| own == name).map_or_else(dash, |(_, ms)| format!("{ms:.4}"));
            text.push_str(&line(printed(thesis).into_iter().chain(names.iter().map(time))));
        }
        text
    }
}

fn printed(thesis: &ThesisPlant) -> [String; 9] {
    let percent = |share: f64| format!("{:.2} %", 100.0 * share);
    [
        thesis.name.into(),
        thesis.rows.to_string(),
        thesis.cpu_uq_ms.to_string(),
        thesis.gpu_uq_ms.to_string(),
        thesis.gpu_update_ms.to_string(),
        thesis.kernels.to_string(),
        thesis.speedup_uq.to_string(),
        percent(thesis.cpu_occupation),
        percent(thesis.gpu_occupation),
    ]
}

/// A line of a Markdown table.
pub(super) fn line(cells: impl IntoIterator<Item = String>) -> String {
    let cells: Vec<String> = cells.into_iter().map(|cell| cell.replace('|', "\\|")).collect();
    format!("| {} |\n", cells.join(" | "))
}

/// The separator line below the header of a Markdown table.
pub(super) fn rule(columns: usize) -> String {
    format!("|{}\n", "---|".repeat(columns))
}

/// Placeholder for a missing value.
pub(super) fn dash() -> String {
    "-".into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::table::tests::row;

    #[test]
    fn compares_only_full_size_loads_with_the_thesis() {
        let mut cuda = row("single-22-30", "cuda", CacheState::Warm, (10.0, 1e-7));
        cuda.backend = Backend::Cuda;
        let rows = [
            row("single-22-30", "cpu", CacheState::Warm, (50.0, 1e-7)),
            cuda,
            row("plant-2", "cpu", CacheState::Warm, (250.0, 1e-7)),
        ];
        let thesis_comparison = ThesisComparison::of(&rows, |_| true);
        let last = thesis_comparison.table_4_4.last().expect("cells");
        assert_eq!((last.thesis, last.ours), (9.69, Some(5.0)));
        assert_eq!(thesis_comparison.tables_4_5_to_4_7[1].ours, [("cpu".to_owned(), 0.25)]);
        let text = thesis_comparison.markdown();
        assert!(text.contains("| 30 | 5.32 / - | 3.67 / - | 6.6 / - | 8.02 / - | 9.69 / 5.00 |"), "{text}");
        assert!(
            text.contains("| Conifer | 41652 | 0.261 | 0.165 | 1.059 | 1 | 1.58 | 1.57 % | 0.91 % | 0.2500 |"),
            "{text}"
        );
        let reduced = ThesisComparison::of(&rows, |_| false);
        assert!(reduced.table_4_4.iter().all(|single| single.ours.is_none()));
        assert!(reduced.tables_4_5_to_4_7.iter().all(|plant| plant.ours.is_empty()));
    }
}
