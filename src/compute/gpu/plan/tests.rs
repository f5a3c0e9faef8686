//! Tests of the plans of scenes.

use super::super::pack::tests::{deformed, exact, kept, on_the_first, scene, stored, unlit};
use super::super::rings::Rings;
use super::*;
use modalcast_model::scene::Deformation;

fn defines(plan: &Plan) -> Vec<(&str, Vec<&str>)> {
    plan.kernels.iter().map(|kernel| (kernel.name, kernel.defines.clone())).collect()
}

#[test]
fn a_scene_without_modes_normal_maps_and_shear_compiles_none_of_their_branches() {
    let bare = plan(&scene(&[(7, 0), (300, 0)], false, true));
    assert_eq!(
        defines(&bare),
        [("deform", vec!["NARROW", "ORIENT", "SHIFTED"]), ("bounds", vec!["LIGHT"]), ("apply", vec![])]
    );
    assert_eq!(bare.bytes(Role::Tangents) + bare.bytes(Role::RestTangents), 0);
    assert_eq!((bare.bytes(Role::Words), bare.bytes(Role::Scales)), (0, 0));
    assert_eq!(bare.bytes_in, 112 + 48 * 4, "a header and four transforms, no q");
    let left_out: Vec<_> = bare.left_out.iter().map(|part| part.feature).collect();
    let last = ["truncation", "exact_normals", "compensated", "followers", "displacements", "boxes", "batches"];
    assert_eq!(left_out, [&["modes", "normal_maps", "shear"][..], &last].concat());
    assert_eq!(bare.left_out[1].bytes, 16 * (311 + 622), "rest and world tangents of every corner");
}

#[test]
fn a_scene_that_needs_more_leaves_less_out() {
    let full = plan(&scene(&[(7, 2), (300, 0)], true, false));
    assert_eq!(full.kernels[0].defines, ["MODES", "NARROW", "ORIENT", "SHIFTED", "NORMAL_MAPS", "SHEAR"]);
    assert_eq!(full.bytes(Role::Tangents), 16 * 2 * (9 + 302));
    assert_eq!(full.bytes(Role::RestTangents), 64 * (3 + 76), "a quad of four corners each");
    assert_eq!(full.bytes_in, 112 + 48 * 4 + 4 * 4);
    assert_eq!(full.left_out.len(), 7);
}

#[test]
fn followers_need_no_room_in_a_step_and_cost_frames_and_a_macro_once() {
    let (own, on_others) = (scene(&[(7, 2), (300, 0)], false, true), on_the_first(&[(7, 2), (300, 0)]));
    let (alone, follows) = (plan(&own), plan(&on_others));
    assert_eq!((alone.bytes_in, follows.bytes_in), (112 + 48 * 4 + 4 * 4, 112 + 48 + 4 * 4), "three of four follow");
    assert_eq!(follows.bytes(Role::Frames), 8 * 4 + 48 * 3);
    assert_eq!(alone.bytes(Role::Frames), 0);
    let with = |plan: &Plan| defines(plan).iter().filter(|(_, macros)| macros.contains(&"FOLLOWERS")).count();
    assert_eq!((with(&alone), with(&follows)), (0, 2), "in `deform` and `apply`");
    assert_eq!(follows.launches(), alone.launches());
}

#[test]
fn storage_decides_the_bytes_of_u_and_the_macro_that_reads_it() {
    let bytes = |storage| {
        let plan = plan(&stored(&[(300, 8)], storage));
        assert_eq!(plan.kernels[0].defines.last().copied(), storage_define(storage).or(Some("SHEAR")));
        plan.bytes(Role::Words)
    };
    assert_eq!(Storage::ALL.map(bytes), [75 * 48 * 8, 75 * 48 * 4, 75 * 48 * 4, 75 * 48 * 2]);
}

#[test]
fn exact_normals_come_behind_the_positions_and_their_tables_are_planned() {
    let scene = exact(&[(7, 2), (300, 0), (513, 4)]);
    let (plan, rings) = (plan(&scene), Rings::new(&scene));
    let normals = plan.kernel(Launch::Normals).expect("asked for");
    assert_eq!((normals.name, normals.defines.as_slice()), ("normals", ["SHEAR"].as_slice()));
    assert_eq!(plan.kernels[0].defines, ["MODES", "NARROW"]);
    assert_eq!(plan.launches(), 4);
    for (role, bytes) in [
        (Role::CornerSlots, size_of_val(super::super::rings::slots(&scene).as_slice())),
        (Role::Members, size_of_val(rings.members.as_slice())),
        (Role::Rings, size_of_val(rings.begins.as_slice()) + size_of_val(rings.rings.as_slice())),
        (Role::GroupNormals, size_of_val(rings.normals.as_slice())),
    ] {
        assert_eq!(plan.bytes(role), bytes as u64, "{role:?}");
    }
    assert_eq!(plan.bytes(Role::Members), 4 * (9 + 515), "the shape without modes has no groups");
    let rigid = super::plan(&stored(&[(7, 2), (300, 0), (513, 4)], Storage::F32));
    assert_eq!(rigid.bytes(Role::Members) + rigid.bytes(Role::Rings) + rigid.bytes(Role::GroupNormals), 0);
    let left_out = rigid.left_out.iter().find(|part| part.feature == "exact_normals").expect("left out");
    assert_eq!(left_out.bytes, 4 * (9 + 515) + 20 * 6, "members and slots");
}

#[test]
fn displacements_and_boxes_are_outputs_and_macros_of_kernels_that_are_there_and_cost_nothing_unless_kept() {
    let sizes = [(7, 2), (300, 0)];
    let bare = plan(&stored(&sizes, Storage::F32));
    let kept = plan(&kept(&sizes));
    let roles = [Role::Displacements, Role::Pieces, Role::DomainBoxes];
    // Two domains of each shape, in one piece each.
    assert_eq!(roles.map(|role| bare.bytes(role)), [0; 3]);
    assert_eq!(roles.map(|role| kept.bytes(role)), [12 * 2 * (7 + 300), 16 * 4, 24 * 4]);
    assert_eq!(kept.total_bytes() - bare.total_bytes(), 12 * 2 * (7 + 300) + 40 * 4);
    assert!(bare.kernels.iter().all(|kernel| !kernel.defines.iter().any(|name| KEPT.contains(name))));
    let with = |kernel: usize| kept.kernels[kernel].defines.iter().filter(|name| KEPT.contains(name)).count();
    assert_eq!([with(0), with(1), with(2)], [1, 1, 0]);
    assert_eq!((kept.launches(), kept.bytes_in, kept.bytes_out), (bare.launches(), bare.bytes_in, bare.bytes_out));
    let bytes = |name: &str| bare.left_out.iter().find(|part| part.feature == name).map(|part| part.bytes);
    assert_eq!([bytes("displacements"), bytes("boxes")], [Some(12 * 2 * (7 + 300)), Some(40 * 4)]);
}

/// The macros of outputs that are kept for readers.
const KEPT: [&str; 2] = ["DISPLACEMENTS", "BOXES"];

#[test]
fn light_space_is_measured_by_a_macro_of_a_kernel_that_is_there_and_only_for_a_shadow() {
    let sizes = [(7, 2), (300, 0)];
    let (lit, dark) = (plan(&stored(&sizes, Storage::F32)), plan(&unlit(&sizes)));
    let defines = |plan: &Plan| plan.kernel(Launch::Bounds).expect("always").defines.clone();
    assert_eq!((defines(&lit), defines(&dark)), (vec!["LIGHT"], vec![]));
    assert_eq!((lit.bytes_out, dark.bytes_out), (48, 24));
    assert_eq!((lit.launches(), lit.total_bytes()), (dark.launches(), dark.total_bytes()));
    let left_out = |plan: &Plan| plan.left_out.iter().any(|part| part.feature == "shadows");
    assert!(left_out(&dark) && !left_out(&lit));
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
        assert_eq!(plan.kernel(Launch::Apply).is_some(), plan.bytes_of_changes > 0);
        plan.bytes_of_changes > 0
    };
    // Two instances of each shape.
    assert!(!lists(&scene(&[(7, 1)], false, false)), "a quarter of two domains is none");
    assert!(lists(&scene(&[(7, 1), (7, 1)], false, false)));
    let truncated = Deformation { truncation: Some(0.1), ..Deformation::default() };
    assert!(!lists(&deformed(&[(7, 1), (7, 1)], truncated)), "the kept modes go with the whole state");
}

#[test]
fn planned_bytes_are_those_of_the_tables() {
    let scene = scene(&[(7, 2), (300, 0), (513, 4)], true, false);
    let plan = plan(&scene);
    let work = Work::new(&scene, &Coordinates::new(&scene));
    for (role, bytes) in [
        (Role::Tiles, size_of_val(work.tiles.as_slice()) + 4 * work.tiles.len()),
        (Role::Lanes, size_of_val(work.lanes.as_slice())),
        (Role::CornerShifts, size_of_val(work.corner_shifts.as_slice())),
    ] {
        assert_eq!(plan.bytes(role), bytes as u64, "{role:?}");
    }
    assert_eq!(plan.total_bytes(), plan.buffers.iter().map(|buffer| buffer.bytes).sum::<u64>());
}
