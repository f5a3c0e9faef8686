//! Compiles every kernel of a step with NVRTC for several architectures; needs no device.

use rayon::prelude::*;

use super::launch::compile::{CompileJob, nvrtc};
use super::launch::{CAPABILITIES, CompiledVariant, KernelSource};
use super::tables::occupancy::deform_tuning;
use super::tables::{kernels, layout};
use modalcast_model::error::Error;

/// Macros of a variant, and the compute capability.
type Variant = (Vec<&'static str>, (i32, i32));

/// Macros of `deform` that are not features of a scene.
const LAUNCHER_DEFINES: [&str; 1] = ["TILE_LIST"];

/// The compute capability of the H200. Every tested variant is compiled for it.
const SM_90: (i32, i32) = (9, 0);

/// The other compute capabilities. Only some variants are compiled for them.
fn other_capabilities() -> impl Iterator<Item = (i32, i32)> {
    CAPABILITIES.into_iter().filter(|capability| *capability != SM_90)
}

/// The macros of each storage type of U; f32 has none.
fn storage_variants() -> impl Iterator<Item = Vec<&'static str>> {
    std::iter::once(Vec::new()).chain(kernels::STORAGE_DEFINES.map(|storage| vec![storage]))
}

/// All subsets of some macros.
fn subsets(macros: &[&'static str]) -> Vec<Vec<&'static str>> {
    let indices = |set: usize| (0..macros.len()).filter(move |bit| set >> bit & 1 == 1);
    (0..1 << macros.len()).map(|set| indices(set).map(|index| macros[index]).collect()).collect()
}

/// Tested variants of `deform`. All combinations of its features would take hours.
fn deform_variants(features: &[&'static str]) -> Vec<Variant> {
    let mut variants: Vec<Variant> =
        features.iter().chain(&LAUNCHER_DEFINES).map(|feature| (vec![*feature], SM_90)).collect();
    // The number of registers depends mainly on three choices: how modes are summed, how many vertices or corners
    // (items) a lane computes, and the kind of normals. With TILE_LIST, a lane always has one item.
    let lane_defines: [&[&str]; 3] = [&[], &["ONE_ITEM_PER_LANE"], &["ONE_ITEM_PER_LANE", "TILE_LIST"]];
    let normal_defines: [&[&str]; 4] = [
        &[],
        &["RIGID_NORMALS"],
        &["RIGID_NORMALS", "NORMAL_MAPS"],
        &["RIGID_NORMALS", "CORNER_OFFSETS", "NORMAL_MAPS", "SHEAR"],
    ];
    // Adds the product of `lane_defines` and `normal_defines`, each with the macros in `sum` and `others`.
    let mut add_variants = |sum: &[&'static str], normal_defines: &[&[&'static str]], others: &[&'static str]| {
        for (lane, normals) in
            lane_defines.iter().flat_map(|lane| normal_defines.iter().map(move |normals| (lane, normals)))
        {
            variants.push(([sum, lane, normals, others].concat(), SM_90));
        }
    };
    for others in subsets(&["DISPLACEMENTS", "FOLLOWERS"]) {
        add_variants(&[], &normal_defines, &others);
    }
    for storage in storage_variants() {
        let sum = |options: &[&'static str]| [&["MODES"], storage.as_slice(), options].concat();
        for options in [&[][..], &["COMPENSATED_SUM"]] {
            add_variants(&sum(options), &normal_defines, &[]);
        }
        // Displacements and followers need further registers, so they are combined with the sum that needs the most.
        // Entries 1 and 2 of `normal_defines` are rigid normals without and with normal maps.
        add_variants(&sum(&["COMPENSATED_SUM"]), &normal_defines[1..3], &["DISPLACEMENTS"]);
        add_variants(&sum(&["COMPENSATED_SUM"]), &normal_defines[1..3], &["FOLLOWERS"]);
    }
    // The variant with one warp per axis reads U as f32, and has neither other storage types nor tile lists.
    let axis_sum =
        |options: &[&'static str]| [&["MODES", "ONE_ITEM_PER_LANE", kernels::AXIS_PER_WARP], options].concat();
    for options in [&[][..], &["COMPENSATED_SUM"]] {
        variants.extend(normal_defines.map(|normals| ([axis_sum(options).as_slice(), normals].concat(), SM_90)));
    }
    let largest_axis_sum = axis_sum(
        &[&["COMPENSATED_SUM", "DISPLACEMENTS", "FOLLOWERS"], normal_defines[normal_defines.len() - 1]].concat(),
    );
    variants.extend(CAPABILITIES.map(|capability| (largest_axis_sum.clone(), capability)));
    variants.extend(CAPABILITIES.map(|capability| (axis_sum(&[]), capability)));
    for storage in storage_variants() {
        let smallest = [&["MODES"], storage.as_slice()].concat();
        let largest = [features, &LAUNCHER_DEFINES, &storage].concat();
        // With DISPLACEMENTS_ONLY, a macro of the benchmarks, `deform` writes no other output.
        variants.push(([smallest.as_slice(), &["DISPLACEMENTS", "DISPLACEMENTS_ONLY"]].concat(), SM_90));
        variants.push((largest.clone(), SM_90));
        for capability in other_capabilities() {
            variants.extend([&smallest, &largest].map(|defines| (defines.clone(), capability)));
        }
    }
    variants
}

/// All variants of `batch` for compute capability 9.0. For other capabilities, only the variants with groups of 16
/// domains, the largest size, which has neither BATCH_4 nor BATCH_8.
fn batch_variants(features: &[&'static str]) -> Vec<Variant> {
    let has_one_group_size = |set: &Vec<&str>| !(set.contains(&"BATCH_4") && set.contains(&"BATCH_8"));
    let sm_90_variants = subsets(features)
        .into_iter()
        .filter(has_one_group_size)
        .flat_map(|set| storage_variants().map(move |storage| ([set.clone(), storage].concat(), SM_90)));
    let other_variants =
        other_capabilities().flat_map(|capability| storage_variants().map(move |storage| (storage, capability)));
    sm_90_variants.chain(other_variants).collect()
}

/// All variants of a kernel that is neither `deform` nor `batch`.
fn all_variants(features: &[&'static str]) -> Vec<Variant> {
    CAPABILITIES
        .into_iter()
        .flat_map(|capability| subsets(features).into_iter().map(move |set| (set, capability)))
        .collect()
}

/// Compiles all variants on all cores. NVRTC programs are independent of each other.
fn compile_variants(kernel: &KernelSource, variants: &[Variant]) -> Vec<CompiledVariant> {
    variants.par_iter().map(|(defines, capability)| compile(kernel, defines, *capability)).collect()
}

/// Compiles a variant as its launcher does.
fn compile(kernel: &KernelSource, defines: &[&str], capability: (i32, i32)) -> CompiledVariant {
    let tuning = (kernel.name == "deform").then(|| deform_tuning(defines, capability));
    let defines: Vec<&str> = defines.iter().copied().chain(tuning.as_deref()).collect();
    CompiledVariant::new(kernel.name, kernel.source, &defines, capability)
}

#[test]
#[ignore = "needs NVRTC: deploy/check installs it"]
fn nvrtc_compiles_every_kernel_without_spilling() {
    for kernel in kernels::KERNELS {
        let variants = match kernel.name {
            "deform" => deform_variants(kernel.features),
            "batch" => batch_variants(kernel.features),
            _ => all_variants(kernel.features),
        };
        let describe_spill = |(variant, compiled): (&Variant, CompiledVariant)| {
            let spill_bytes = compiled.spill_bytes();
            // Batches may spill up to 24 bytes: with more registers, fewer blocks would fit on a multiprocessor.
            let max_spill_bytes = if kernel.name == "batch" { 24 } else { 0 };
            (spill_bytes > max_spill_bytes).then(|| format!("{variant:?}: {spill_bytes} bytes"))
        };
        let spilling: Vec<String> =
            variants.iter().zip(compile_variants(&kernel, &variants)).filter_map(describe_spill).collect();
        assert_eq!(
            spilling,
            Vec::<String>::new(),
            "{} of {} variants of {} spill",
            spilling.len(),
            variants.len(),
            kernel.name
        );
    }
}

/// Kernel, a macro that adds code, and the macros that this macro requires. [`ALTERNATIVES`] has all other macros.
const ADDED_CODE: [(&str, &str, &[&str]); 13] = [
    ("deform", "MODES", &[]),
    ("deform", "COMPENSATED_SUM", &["MODES"]),
    ("deform", "DISPLACEMENTS", &["MODES"]),
    ("bounds", "ORIENTED_BOUNDS", &[]),
    ("bounds", "DOMAIN_BOXES", &[]),
    ("deform", "RIGID_NORMALS", &[]),
    ("deform", "NORMAL_MAPS", &["RIGID_NORMALS"]),
    ("deform", "SHEAR", &["RIGID_NORMALS"]),
    ("deform", "FOLLOWERS", &[]),
    ("batch", "FOLLOWERS", &[]),
    ("normals", "NORMAL_MAPS", &[]),
    ("normals", "SHEAR", &[]),
    ("normals", "FOLLOWERS", &[]),
];
/// Macros that select among code of similar length. FOLLOWERS of `apply` and CORNER_OFFSETS of `deform` add less code
/// than the padding of their cubins.
const ALTERNATIVES: [(&str, &str); 5] = [
    ("batch", "BATCH_8"),
    ("batch", "BATCH_4"),
    ("deform", "ONE_ITEM_PER_LANE"),
    ("apply", "FOLLOWERS"),
    ("deform", "CORNER_OFFSETS"),
];

#[test]
#[ignore = "needs NVRTC: deploy/check installs it"]
fn nvrtc_omits_the_code_of_unused_features() {
    for kernel in kernels::KERNELS {
        let cubin_bytes = |defines: &[&'static str]| compile(&kernel, defines, SM_90).cubin.len();
        assert_eq!(cubin_bytes(&["UNKNOWN"]), cubin_bytes(&[]), "expected an unknown macro to change nothing");
        for feature in kernel.features.iter().filter(|feature| !ALTERNATIVES.contains(&(kernel.name, feature))) {
            let is_feature =
                |(kernel_name, name, _): &&(&str, &str, &[&str])| (kernel_name, name) == (&kernel.name, feature);
            let (.., required) = ADDED_CODE.iter().find(is_feature).expect("an entry of ADDED_CODE");
            let (bytes_without, bytes_with) = (cubin_bytes(required), cubin_bytes(&[*required, &[*feature]].concat()));
            assert!(bytes_without < bytes_with, "{feature} of {}: {bytes_without} and {bytes_with} bytes", kernel.name);
        }
    }
}

#[test]
#[ignore = "needs NVRTC: deploy/check installs it"]
fn nvrtc_layout_equals_the_host_layout() {
    let nvrtc = nvrtc().expect("NVRTC");
    let compile_assertion = |constant: &layout::LayoutConstant, value: u32| {
        let source = format!("{}static_assert(({}) == {value}u, \"\");", layout::PRELUDE, constant.expression);
        nvrtc.compile(&CompileJob::new("layout", &source, &[], (8, 0)))
    };
    for constant in layout::layout_constants() {
        compile_assertion(&constant, constant.host).expect("the same value on host and device");
        compile_assertion(&constant, constant.host ^ 4).expect_err("negative control: a wrong value");
    }
    nvrtc
        .compile(&CompileJob::new("layout_values", &layout::layout_kernel_source(), &[], (9, 0)))
        .expect("a kernel that compiles");
}

#[test]
#[ignore = "needs NVRTC: deploy/check installs it"]
fn nvrtc_reports_invalid_code_and_unknown_architectures() {
    let nvrtc = nvrtc().expect("NVRTC");
    let result = nvrtc.compile(&CompileJob::new("broken", "__global__ void f() { wrong; }", &[], (8, 0)));
    assert!(result.expect_err("invalid C++").to_string().contains("wrong"));
    let error = nvrtc.compile(&CompileJob::new("empty", "", &[], (1, 0))).expect_err("an unsupported architecture");
    assert!(matches!(error, Error::Unavailable { .. }), "{error}");
}
