//! Compiles every kernel of a step with NVRTC for several architectures; needs no device.

use rayon::prelude::*;

use super::launch::compile::{CompileJob, nvrtc};
use super::launch::{CAPABILITIES, CompiledVariant, KernelSource};
use super::tables::occupancy::deform_tuning;
use super::tables::{kernels, layout};
use modalcast_model::error::Error;

/// Macros of a variant, and the architecture.
type Variant = (Vec<&'static str>, (i32, i32));

/// Macros of `deform` that are not features of a scene: LISTED, for tile lists.
const UNPLANNED_DEFINES: [&str; 1] = ["TILE_LIST"];

/// U in f32, and in each type that has a macro.
fn storages() -> impl Iterator<Item = Vec<&'static str>> {
    std::iter::once(Vec::new()).chain(kernels::STORAGE_DEFINES.map(|storage| vec![storage]))
}

/// All subsets of a few macros.
fn subsets(of: &[&'static str]) -> Vec<Vec<&'static str>> {
    let chosen = |set: usize| (0..of.len()).filter(move |bit| set >> bit & 1 == 1);
    (0..1 << of.len()).map(|set| chosen(set).map(|bit| of[bit]).collect()).collect()
}

/// Tested variants of `deform`: all combinations of its features would take hours.
fn variants_of_deform(features: &[&'static str]) -> Vec<Variant> {
    let large = (9, 0);
    let mut list: Vec<Variant> =
        features.iter().chain(&UNPLANNED_DEFINES).map(|feature| (vec![*feature], large)).collect();
    // The registers that the sum, the shape of a tile and the kind of normals need; kernels for lists are always
    // narrow.
    let shapes: [&[&str]; 3] = [&[], &["ONE_ITEM_PER_LANE"], &["ONE_ITEM_PER_LANE", "TILE_LIST"]];
    let orient: [&[&str]; 4] = [
        &[],
        &["RIGID_NORMALS"],
        &["RIGID_NORMALS", "NORMAL_MAPS"],
        &["RIGID_NORMALS", "CORNER_OFFSETS", "NORMAL_MAPS", "SHEAR"],
    ];
    let mut with = |sum: &[&'static str], orient: &[&[&'static str]], more: &[&'static str]| {
        let ends = shapes.into_iter().flat_map(|shape| orient.iter().map(move |orient| [shape, *orient].concat()));
        list.extend(ends.map(|defines| ([sum, &defines, more].concat(), large)));
    };
    for more in subsets(&["DISPLACEMENTS", "FOLLOWERS"]) {
        with(&[], &orient, &more);
    }
    for storage in storages() {
        let sum = |more: &[&'static str]| [&["MODES"], storage.as_slice(), more].concat();
        let largest = ["MODE_TRUNCATION", "COMPENSATED_SUM"];
        // The two 16-bit types decode with the same registers, so the sums between the smallest and the largest one are
        // compiled for one of them.
        let mut sums = subsets(&largest);
        sums.retain(|more| storage != ["STORE_BF16"] || more.len() != 1);
        for more in &sums {
            with(&sum(more), &orient, &[]);
        }
        // The registers that readback outputs and followers add to the largest sum.
        with(&sum(&largest), &orient[1..3], &["DISPLACEMENTS"]);
        with(&sum(&largest), &orient[1..3], &["FOLLOWERS"]);
    }
    for storage in storages() {
        let smallest = [&["MODES"], storage.as_slice()].concat();
        let largest = [features, &UNPLANNED_DEFINES, &storage].concat();
        list.push(([smallest.as_slice(), &["DISPLACEMENTS", "DISPLACEMENTS_ONLY"]].concat(), large));
        list.push((largest.clone(), large));
        for capability in [(7, 5), (8, 0), (12, 0)] {
            list.extend([&smallest, &largest].map(|defines| (defines.clone(), capability)));
        }
    }
    list
}

/// All variants of `batch` for a large device, and the largest group size for the other architectures.
fn variants_of_batch(features: &[&'static str]) -> Vec<Variant> {
    let counts = subsets(features).into_iter().filter(|set| !(set.contains(&"BATCH_4") && set.contains(&"BATCH_8")));
    let large: Vec<Vec<&str>> =
        counts.flat_map(|set| storages().map(move |storage| [set.clone(), storage].concat())).collect();
    let others = [(7, 5), (8, 0), (12, 0)].into_iter();
    let others = others.flat_map(|capability| storages().map(move |storage| (storage, capability)));
    large.into_iter().map(|set| (set, (9, 0))).chain(others).collect()
}

/// All variants of the other kernels.
fn variants_of_others(features: &[&'static str]) -> Vec<Variant> {
    let variants_of = |capability| subsets(features).into_iter().map(move |set| (set, capability));
    CAPABILITIES.into_iter().flat_map(variants_of).collect()
}

/// Compiles all variants on all cores. NVRTC programs are independent of each other.
fn compiled(kernel: &KernelSource, variants: &[Variant]) -> Vec<CompiledVariant> {
    let one = |(defines, capability): &Variant| compile(kernel, defines, *capability);
    variants.par_iter().map(one).collect()
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
            "deform" => variants_of_deform,
            "batch" => variants_of_batch,
            _ => variants_of_others,
        }(kernel.features);
        let spills = |(variant, compiled): (&Variant, CompiledVariant)| {
            let spill_bytes = compiled.spill_bytes();
            // The header comment of batch.cu says what it spills and how rarely.
            let allowed = if kernel.name == "batch" { 16 } else { 0 };
            (spill_bytes > allowed).then(|| format!("{variant:?}: {spill_bytes} bytes"))
        };
        let spilling: Vec<String> = variants.iter().zip(compiled(&kernel, &variants)).filter_map(spills).collect();
        assert_eq!(spilling, Vec::<String>::new(), "{} of {} of {}", spilling.len(), variants.len(), kernel.name);
    }
}

/// Macros that add code, each with the macros that it builds on. The other macros choose among code of similar length.
const ADDED_CODE: [(&str, &str, &[&str]); 14] = [
    ("deform", "MODES", &[]),
    ("deform", "COMPENSATED_SUM", &["MODES"]),
    ("deform", "DISPLACEMENTS", &["MODES"]),
    ("bounds", "ORIENTED_BOUNDS", &[]),
    ("bounds", "DOMAIN_BOXES", &[]),
    ("deform", "RIGID_NORMALS", &[]),
    ("deform", "CORNER_OFFSETS", &["RIGID_NORMALS"]),
    ("deform", "NORMAL_MAPS", &["RIGID_NORMALS"]),
    ("deform", "SHEAR", &["RIGID_NORMALS"]),
    ("deform", "FOLLOWERS", &[]),
    ("batch", "FOLLOWERS", &[]),
    ("normals", "NORMAL_MAPS", &[]),
    ("normals", "SHEAR", &[]),
    ("normals", "FOLLOWERS", &[]),
];
/// Macros that choose among code of similar length. FOLLOWERS of `apply` adds less code than the padding of its file.
const ALTERNATIVES: [(&str, &str); 5] = [
    ("batch", "BATCH_8"),
    ("batch", "BATCH_4"),
    ("deform", "ONE_ITEM_PER_LANE"),
    ("deform", "MODE_TRUNCATION"),
    ("apply", "FOLLOWERS"),
];

#[test]
#[ignore = "needs NVRTC: deploy/check installs it"]
fn nvrtc_leaves_out_the_code_of_a_feature_that_is_left_out() {
    for kernel in kernels::KERNELS {
        let bytes = |defines: &[&'static str]| compile(&kernel, defines, (9, 0)).cubin.len();
        assert_eq!(bytes(&["UNKNOWN"]), bytes(&[]), "a macro that nothing reads changes nothing");
        for feature in kernel.features.iter().filter(|feature| !ALTERNATIVES.contains(&(kernel.name, feature))) {
            let (.., base) =
                ADDED_CODE.iter().find(|(name, own, _)| (name, own) == (&kernel.name, feature)).expect("known");
            let (without, with) = (bytes(base), bytes(&[*base, &[*feature]].concat()));
            assert!(without < with, "{} of {}: {without} and {with} bytes", feature, kernel.name);
        }
    }
}

#[test]
#[ignore = "needs NVRTC: deploy/check installs it"]
fn nvrtc_agrees_with_the_host_on_every_size_and_offset_and_would_notice() {
    let nvrtc = nvrtc().expect("NVRTC");
    let check = |agreement: &layout::LayoutConstant, host: u32| {
        let source = format!("{}static_assert(({}) == {host}u, \"\");", layout::PRELUDE, agreement.expression);
        nvrtc.compile(&CompileJob::new("layout", &source, &[], (8, 0)))
    };
    for agreement in layout::layout_constants() {
        check(&agreement, agreement.host).expect("host and device agree");
        check(&agreement, agreement.host ^ 4).expect_err("the judge can fail");
    }
    nvrtc
        .compile(&CompileJob::new("layout_values", &layout::layout_kernel_source(), &[], (9, 0)))
        .expect("the report compiles");
}

#[test]
#[ignore = "needs NVRTC: deploy/check installs it"]
fn nvrtc_refusals_carry_the_log() {
    let nvrtc = nvrtc().expect("NVRTC");
    let broken = nvrtc.compile(&CompileJob::new("broken", "__global__ void f() { wrong; }", &[], (8, 0)));
    assert!(broken.expect_err("no C++").to_string().contains("wrong"), "the log names the culprit");
    let ancient = nvrtc.compile(&CompileJob::new("empty", "", &[], (1, 0))).expect_err("sm_10 is gone");
    assert!(matches!(ancient, Error::Unavailable { .. }), "{ancient}");
}
