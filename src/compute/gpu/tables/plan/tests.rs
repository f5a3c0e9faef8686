//! Tests of the plans of scenes.

use super::super::kernels::storage_define;
use super::super::rings::RingTables;
use super::super::test_scenes::{deformed, exact, kept, on_the_first, scene, stored, unlit};
use super::super::work::{CoordinateLayout, WorkList};
use super::*;
use modalcast_model::backend_settings::BatchPolicy;
use modalcast_model::scene::{DeformationSettings, StorageType};

/// The plan for a deformer that bounds the positions along the axes of the scene's shadow, if it has one.
fn plan(scene: &Scene) -> DeformPlan {
    super::plan(scene, CudaDeformerOptions::with_bounding_axes(scene.light_axes()))
}

fn defines(plan: &DeformPlan) -> Vec<(&str, Vec<&str>)> {
    plan.kernels.iter().map(|kernel| (kernel.name, kernel.defines.clone())).collect()
}

#[test]
fn a_scene_without_modes_normal_maps_and_shear_compiles_none_of_their_branches() {
    let bare = plan(&scene(&[(7, 0), (300, 0)], false, true));
    assert_eq!(
        defines(&bare),
        [
            ("deform", vec!["ONE_ITEM_PER_LANE", "RIGID_NORMALS", "CORNER_OFFSETS"]),
            ("bounds", vec!["ORIENTED_BOUNDS"]),
            ("apply", vec![])
        ]
    );
    assert_eq!(bare.bytes(BufferRole::Tangents) + bare.bytes(BufferRole::RestTangents), 0);
    assert_eq!((bare.bytes(BufferRole::ModeWords), bare.bytes(BufferRole::Scales)), (0, 0));
    assert_eq!(bare.bytes_in, 112 + 48 * 4, "a header and four transforms, no q");
    let omitted: Vec<_> = bare.omitted.iter().map(|part| part.feature).collect();
    let last = ["truncation", "exact_normals", "compensated", "followers", "displacements", "boxes", "batches"];
    assert_eq!(omitted, [&["modes", "normal_maps", "shear"][..], &last].concat());
    assert_eq!(bare.omitted[1].bytes, 16 * (311 + 622), "rest and world tangents of every corner");
}

#[test]
fn a_scene_that_needs_more_leaves_less_out() {
    let full = plan(&scene(&[(7, 2), (300, 0)], true, false));
    assert_eq!(
        full.kernels[0].defines,
        ["MODES", "ONE_ITEM_PER_LANE", "RIGID_NORMALS", "CORNER_OFFSETS", "NORMAL_MAPS", "SHEAR"]
    );
    assert_eq!(full.bytes(BufferRole::Tangents), 16 * 2 * (9 + 302));
    assert_eq!(full.bytes(BufferRole::RestTangents), 64 * (3 + 76), "a quad of four corners each");
    assert_eq!(full.bytes_in, 112 + 48 * 4 + 4 * 4);
    assert_eq!(full.omitted.len(), 7);
}

#[test]
fn followers_need_no_room_in_a_step_and_cost_frames_and_a_macro_once() {
    let (own, on_others) = (scene(&[(7, 2), (300, 0)], false, true), on_the_first(&[(7, 2), (300, 0)]));
    let (alone, follows) = (plan(&own), plan(&on_others));
    assert_eq!((alone.bytes_in, follows.bytes_in), (112 + 48 * 4 + 4 * 4, 112 + 48 + 4 * 4), "three of four follow");
    assert_eq!(follows.bytes(BufferRole::FollowerFrames), 8 * 4 + 48 * 3);
    assert_eq!(alone.bytes(BufferRole::FollowerFrames), 0);
    let with = |plan: &DeformPlan| defines(plan).iter().filter(|(_, macros)| macros.contains(&"FOLLOWERS")).count();
    assert_eq!((with(&alone), with(&follows)), (0, 2), "in `deform` and `apply`");
    assert_eq!(follows.launches(), alone.launches());
}

#[test]
fn storage_decides_the_bytes_of_u_and_the_macro_that_reads_it() {
    let bytes = |storage| {
        let plan = plan(&stored(&[(300, 8)], storage));
        assert_eq!(plan.kernels[0].defines.last().copied(), storage_define(storage).or(Some("SHEAR")));
        plan.bytes(BufferRole::ModeWords)
    };
    assert_eq!(StorageType::ALL.map(bytes), [75 * 48 * 8, 75 * 48 * 4, 75 * 48 * 4, 75 * 48 * 2]);
}

#[test]
fn exact_normals_come_behind_the_positions_and_their_tables_are_planned() {
    let scene = exact(&[(7, 2), (300, 0), (513, 4)]);
    let (plan, rings) = (plan(&scene), RingTables::new(&scene));
    let normals = plan.kernel(KernelKind::Normals).expect("asked for");
    assert_eq!((normals.name, normals.defines.as_slice()), ("normals", ["SHEAR"].as_slice()));
    assert_eq!(plan.kernels[0].defines, ["MODES", "ONE_ITEM_PER_LANE"]);
    assert_eq!(plan.launches(), 4);
    for (role, bytes) in [
        (BufferRole::CornerSlots, size_of_val(super::super::rings::slots(&scene).as_slice())),
        (BufferRole::CornerGroups, size_of_val(rings.members.as_slice())),
        (BufferRole::RingTables, size_of_val(rings.ring_offsets.as_slice()) + size_of_val(rings.rings.as_slice())),
        (BufferRole::GroupNormals, size_of_val(rings.normals.as_slice())),
    ] {
        assert_eq!(plan.bytes(role), bytes as u64, "{role:?}");
    }
    assert_eq!(plan.bytes(BufferRole::CornerGroups), 4 * (9 + 515), "the shape without modes has no groups");
    let rigid = super::plan(&stored(&[(7, 2), (300, 0), (513, 4)], StorageType::F32), CudaDeformerOptions::default());
    assert_eq!(
        rigid.bytes(BufferRole::CornerGroups)
            + rigid.bytes(BufferRole::RingTables)
            + rigid.bytes(BufferRole::GroupNormals),
        0
    );
    let omitted = rigid.omitted.iter().find(|part| part.feature == "exact_normals").expect("left out");
    assert_eq!(omitted.bytes, 4 * (9 + 515) + 20 * 6, "members and slots");
}

#[test]
fn displacements_and_boxes_are_outputs_and_macros_of_kernels_that_are_there_and_cost_nothing_unless_kept() {
    let sizes = [(7, 2), (300, 0)];
    let bare = plan(&stored(&sizes, StorageType::F32));
    let kept = plan(&kept(&sizes));
    let roles = [BufferRole::Displacements, BufferRole::BoxSegments, BufferRole::DomainBoxes];
    // Two domains of each shape, in one piece each.
    assert_eq!(roles.map(|role| bare.bytes(role)), [0; 3]);
    assert_eq!(roles.map(|role| kept.bytes(role)), [12 * 2 * (7 + 300), 16 * 4, 24 * 4]);
    assert_eq!(kept.total_bytes() - bare.total_bytes(), 12 * 2 * (7 + 300) + 40 * 4);
    assert!(bare.kernels.iter().all(|kernel| !kernel.defines.iter().any(|name| KEPT.contains(name))));
    let with = |kernel: usize| kept.kernels[kernel].defines.iter().filter(|name| KEPT.contains(name)).count();
    assert_eq!([with(0), with(1), with(2)], [1, 1, 0]);
    assert_eq!((kept.launches(), kept.bytes_in, kept.bytes_out), (bare.launches(), bare.bytes_in, bare.bytes_out));
    let bytes = |name: &str| bare.omitted.iter().find(|part| part.feature == name).map(|part| part.bytes);
    assert_eq!([bytes("displacements"), bytes("boxes")], [Some(12 * 2 * (7 + 300)), Some(40 * 4)]);
}

/// The macros of outputs that are kept for readers.
const KEPT: [&str; 2] = ["DISPLACEMENTS", "DOMAIN_BOXES"];

#[test]
fn light_space_is_measured_by_a_macro_of_a_kernel_that_is_there_and_only_for_a_shadow() {
    let sizes = [(7, 2), (300, 0)];
    let (lit, dark) = (plan(&stored(&sizes, StorageType::F32)), plan(&unlit(&sizes)));
    let defines = |plan: &DeformPlan| plan.kernel(KernelKind::Bounds).expect("always").defines.clone();
    assert_eq!((defines(&lit), defines(&dark)), (vec!["ORIENTED_BOUNDS"], vec![]));
    assert_eq!((lit.bytes_out, dark.bytes_out), (48, 24));
    assert_eq!((lit.launches(), lit.total_bytes()), (dark.launches(), dark.total_bytes()));
    let omitted = |plan: &DeformPlan| plan.omitted.iter().any(|part| part.feature == "shadows");
    assert!(omitted(&dark) && !omitted(&lit));
}

#[test]
fn launches_do_not_grow_with_the_number_of_domains() {
    let (few, many) = (scene(&[(7, 1)], false, false), scene(&[(7, 1); 3000], false, false));
    assert_eq!((plan(&few).launches(), plan(&many).launches()), (2, 3));
}

#[test]
fn a_scene_whose_steps_are_always_whole_plans_nothing_for_lists() {
    let lists = |scene: &Scene| {
        let plan = plan(scene);
        assert_eq!(plan.kernel(KernelKind::Apply).is_some(), plan.change_list_bytes > 0);
        plan.change_list_bytes > 0
    };
    // Two instances of each shape.
    assert!(!lists(&scene(&[(7, 1)], false, false)), "a quarter of two domains is none");
    assert!(lists(&scene(&[(7, 1), (7, 1)], false, false)));
    let truncated = DeformationSettings { truncation: Some(0.1), ..DeformationSettings::default() };
    assert!(!lists(&deformed(&[(7, 1), (7, 1)], truncated)), "the kept modes go with the whole state");
}

#[test]
fn planned_bytes_are_those_of_the_tables() {
    let scene = scene(&[(7, 2), (300, 0), (513, 4)], true, false);
    let plan = plan(&scene);
    let work = WorkList::new(&scene, &CoordinateLayout::new(&scene), BatchPolicy::default());
    for (role, bytes) in [
        (BufferRole::WarpTiles, size_of_val(work.tiles.as_slice()) + 4 * work.tiles.len()),
        (BufferRole::MixedQuads, size_of_val(work.mixed_quads.as_slice())),
        (BufferRole::CornerOffsets, size_of_val(work.corner_offsets.as_slice())),
    ] {
        assert_eq!(plan.bytes(role), bytes as u64, "{role:?}");
    }
    assert_eq!(plan.total_bytes(), plan.buffers.iter().map(|buffer| buffer.bytes).sum::<u64>());
}
