//! Compares our results with the thesis: values for `report.json`, tables for `report.md`.

use serde::Serialize;

use super::markdown_table::{dash, table};
use super::table::DeformRow;
use super::thesis::{CPU_OVER_GPU, PLANTS, POWERS, RANKS, ThesisPlant};
use super::timing::CacheState;

/// The variants of table 4.4: positions of one domain on all cores, and by the kernels without copies to the device.
const CPU_POSITIONS: &str = "cpu f32";
const CUDA_POSITIONS: &str = "cuda f32 positions";

/// One cell of table 4.4 with our result.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SingleDomainComparison {
    /// Binary logarithm of the number of vertices.
    pub power: u32,
    pub rank: usize,
    /// Table 4.4: CPU time over GPU time.
    pub thesis: f64,
    /// Time of `cpu f32` divided by that of `cuda f32 positions`; `None` without both. The thesis compares U q alone.
    /// No CPU variant computes that alone, so both sides compute positions.
    pub ours: Option<f64>,
}

/// One plant of the thesis with our results.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PlantComparison {
    pub thesis: ThesisPlant,
    /// Name and median milliseconds, with warm caches, of each variant that passed.
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
    /// Compares the rows of full-size workloads with the thesis.
    pub fn new(rows: &[DeformRow], is_full_size: impl Fn(&str) -> bool) -> Self {
        let warm_rows = |load: &str| -> Vec<&DeformRow> {
            let is_comparable = |row: &&DeformRow| {
                row.load == load && row.cache == CacheState::Warm && row.timing.is_some() && is_full_size(load)
            };
            rows.iter().filter(is_comparable).collect()
        };
        let compare_single = |row: usize, column: usize| {
            let (power, rank) = (POWERS[column], RANKS[row]);
            let timed_rows = warm_rows(&format!("single-{power}-{rank}"));
            let median_us =
                |name: &str| timed_rows.iter().find(|row| row.name == name).and_then(|row| Some(row.timing?.median_us));
            let ours = median_us(CPU_POSITIONS).zip(median_us(CUDA_POSITIONS)).map(|(cpu, cuda)| cpu / cuda);
            SingleDomainComparison { power, rank, thesis: CPU_OVER_GPU[row][column], ours }
        };
        let cells = (0..RANKS.len()).flat_map(|row| (0..POWERS.len()).map(move |column| (row, column)));
        let compare_plant = |(index, thesis): (usize, ThesisPlant)| {
            let timed_rows = warm_rows(&format!("plant-{}", index + 1)).into_iter();
            let ours = timed_rows.filter_map(|row| Some((row.name.clone(), row.timing?.median_us / 1e3)));
            PlantComparison { thesis, ours: ours.collect() }
        };
        Self {
            source: "thesis, chapter 4: GeForce GTX 680; CPU with OpenMP, 16 threads",
            table_4_4: cells.map(|(row, column)| compare_single(row, column)).collect(),
            tables_4_5_to_4_7: PLANTS.into_iter().enumerate().map(compare_plant).collect(),
        }
    }

    /// The tables with results of ours, as Markdown; empty without any.
    pub fn markdown(&self) -> String {
        let mut tables = String::new();
        if self.table_4_4.iter().any(|comparison| comparison.ours.is_some()) {
            let table = single_domain_table(&self.table_4_4);
            tables.push_str(&format!(
                "\nTable 4.4, CPU time over GPU time: the thesis for U q / `{CPU_POSITIONS}` over \
                 `{CUDA_POSITIONS}`:\n\n{table}"
            ));
        }
        let measured: Vec<PlantComparison> =
            self.tables_4_5_to_4_7.iter().filter(|comparison| !comparison.ours.is_empty()).cloned().collect();
        if !measured.is_empty() {
            let table = plant_table(&measured);
            tables.push_str(&format!(
                "\nTables 4.5 to 4.7, milliseconds of the thesis, then ours (complete vertex update):\n\n{table}"
            ));
        }
        if tables.is_empty() {
            return tables;
        }
        format!(
            "\n## Comparison with the thesis\n\nSource: {}. Our results for loads of reduced size are omitted.\n{tables}",
            self.source
        )
    }
}

fn single_domain_table(comparisons: &[SingleDomainComparison]) -> String {
    let powers = POWERS.map(|power| format!("2^{power}"));
    let head: Vec<&str> = std::iter::once("r").chain(powers.iter().map(String::as_str)).collect();
    let cell = |comparison: &SingleDomainComparison| {
        format!("{} / {}", comparison.thesis, comparison.ours.map_or_else(dash, |ours| format!("{ours:.2}")))
    };
    let rows = RANKS.iter().zip(comparisons.chunks_exact(POWERS.len()));
    table(&head, rows.map(|(rank, row)| std::iter::once(rank.to_string()).chain(row.iter().map(cell))))
}

fn plant_table(comparisons: &[PlantComparison]) -> String {
    let mut variants: Vec<&str> = Vec::new();
    for (name, _) in comparisons.iter().flat_map(|comparison| &comparison.ours) {
        if !variants.contains(&name.as_str()) {
            variants.push(name);
        }
    }
    let thesis_columns =
        ["species", "u", "CPU t_uq", "GPU t_uq", "GPU t_vb", "kernels", "k_uq", "CPU O_uq", "GPU O_uq"];
    let head = [&thesis_columns[..], &variants].concat();
    let row = |comparison: &PlantComparison| {
        let times = comparison.ours.clone();
        let format_time = move |variant: &&str| {
            let time = times.iter().find(|(name, _)| name == variant);
            time.map_or_else(dash, |(_, ms)| format!("{ms:.4}"))
        };
        plant_cells(&comparison.thesis).into_iter().chain(variants.iter().map(format_time)).collect::<Vec<String>>()
    };
    table(&head, comparisons.iter().map(row))
}

fn plant_cells(thesis: &ThesisPlant) -> [String; 9] {
    let percent = |fraction: f64| format!("{:.2} %", 100.0 * fraction);
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::table::tests::row;

    #[test]
    fn compares_only_full_size_loads_with_the_thesis() {
        let rows = [
            row("single-22-30", CPU_POSITIONS, CacheState::Warm, (50.0, 1e-7)),
            row("single-22-30", "cuda f32 Uq", CacheState::Warm, (5.0, 1e-7)),
            row("single-22-30", CUDA_POSITIONS, CacheState::Warm, (10.0, 1e-7)),
            row("plant-2", "cpu", CacheState::Warm, (250.0, 1e-7)),
        ];
        let comparison = ThesisComparison::new(&rows, |_| true);
        let last = comparison.table_4_4.last().expect("a cell");
        assert_eq!((last.thesis, last.ours), (9.69, Some(5.0)));
        assert_eq!(comparison.tables_4_5_to_4_7[1].ours, [("cpu".to_owned(), 0.25)]);
        let text = comparison.markdown();
        assert!(text.contains("| 30 | 5.32 / - | 3.67 / - | 6.6 / - | 8.02 / - | 9.69 / 5.00 |"), "{text}");
        assert!(
            text.contains("| Conifer | 41652 | 0.261 | 0.165 | 1.059 | 1 | 1.58 | 1.57 % | 0.91 % | 0.2500 |"),
            "{text}"
        );
        let reduced = ThesisComparison::new(&rows, |_| false);
        assert!(reduced.table_4_4.iter().all(|single| single.ours.is_none()));
        assert!(reduced.tables_4_5_to_4_7.iter().all(|plant| plant.ours.is_empty()));
        assert_eq!(reduced.markdown(), "", "expected no table without results");
    }
}
