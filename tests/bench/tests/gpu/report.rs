//! The complete deformation report with a CUDA device: every variant is within its error bound, and every workload has
//! timed CUDA variants.

use modalcast_bench::bench::LocalMachine;
use modalcast_bench::validate::ValidationLimits;
use modalcast_bench::workloads::{Size, WorkloadKind};
use modalcast_bench::{DeformReportOptions, WorkloadSource, deform};
use modalcast_model::deform::Backend;

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_all_variants_of_quick_workloads_pass_and_are_timed() {
    let names = ["single-14-20", "a", "a-positions", "b", "c", "cancel", "batch", "plant-2", "plant-5"];
    let kinds = names.iter().flat_map(|name| WorkloadKind::parse(name).expect("workloads"));
    let sources = kinds.map(WorkloadSource::Synthetic).collect();
    // All steps and all variants.
    let validation = ValidationLimits { seeds: 4, steps: usize::MAX, seconds: f64::INFINITY };
    let options = DeformReportOptions { sources, validation, replays: 20, variants: Vec::new(), size: Size::Quick };
    let report = deform(&options, &LocalMachine::open(), |_| Ok(())).expect("expected a report");
    assert!(report.passed(), "{:#?}", report.failed);
    assert!(report.remarks.is_empty(), "{:?}", report.remarks);
    for workload in names {
        let is_cuda_row =
            |row: &&modalcast_bench::table::DeformRow| row.load == workload && row.backend == Backend::Cuda;
        let rows: Vec<_> = report.rows.iter().filter(is_cuda_row).filter(|row| !row.is_skipped).collect();
        assert!(rows.iter().filter(|row| row.timing.is_some() && row.of_copy.is_some()).count() >= 4, "{workload}");
        assert!(rows.iter().any(|row| !row.kernels.is_empty()), "{workload}: expected kernel attributes, got none");
    }
}
