//! The full report on a device: every variant is within its bound, and every load has timed CUDA variants.

use modalcast_bench::bench::LocalMachine;
use modalcast_bench::workloads::{Size, WorkloadKind};
use modalcast_bench::{DeformReportOptions, WorkloadSource, deform};
use modalcast_model::deform::Backend;

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_all_variants_of_quick_loads_pass_and_are_timed() {
    let names = ["single-14-20", "a", "a-positions", "b", "c", "cancel", "batch", "plant-2", "plant-5"];
    let kinds = names.iter().flat_map(|name| WorkloadKind::parse(name).expect("a load"));
    let sources = kinds.map(WorkloadSource::Synthetic).collect();
    let (steps, variants) = (usize::MAX, Vec::new());
    let request = DeformReportOptions { sources, seeds: 4, replays: 20, steps, variants, size: Size::Quick };
    let report = deform(&request, &LocalMachine::open(), |_| Ok(())).expect("expected a report");
    assert!(report.passed(), "{:#?}", report.failed);
    assert!(report.remarks.is_empty(), "{:?}", report.remarks);
    for load in names {
        let timed = |row: &&modalcast_bench::table::DeformRow| row.load == load && row.backend == Backend::Cuda;
        let rows: Vec<_> = report.rows.iter().filter(timed).filter(|row| !row.is_skipped).collect();
        assert!(rows.iter().filter(|row| row.timing.is_some() && row.of_copy.is_some()).count() >= 4, "{load}");
        assert!(rows.iter().any(|row| !row.kernels.is_empty()), "{load}: expected kernel attributes, got none");
    }
}
