//! Tests of the plans of scenes. In these scenes, two domains use each shape, and a shape of n vertices has n + 2
//! corners (`test_scenes`). Expected bytes are written as products of sizes and counts.

use super::super::kernels::storage_define;
use super::super::rings::RingTables;
use super::super::test_scenes::{
    rigid_scene, scene, scene_with_exact_normals, scene_with_followers, scene_with_normal_map, scene_with_readbacks,
    scene_with_storage, scene_without_shadow,
};
use super::super::work::{CoordinateLayout, WorkList};
use super::*;
use modalcast_model::backend_settings::BatchPolicy;
use modalcast_model::scene::{DeformationSettings, StorageType};

/// The plan for a deformer that bounds the positions along the axes of the light, if the scene has a shadow.
fn plan(scene: &Scene) -> DeformPlan {
    super::plan(scene, CudaDeformerOptions::with_bounding_axes(scene.light_axes()))
}

fn defines(plan: &DeformPlan) -> Vec<(&str, Vec<&str>)> {
    plan.kernels.iter().map(|kernel| (kernel.name, kernel.defines.clone())).collect()
}

#[test]
fn unused_features_are_not_compiled_or_stored() {
    let minimal = plan(&rigid_scene(&[(7, 0), (300, 0)]));
    assert_eq!(
        defines(&minimal),
        [
            ("deform", vec!["ONE_ITEM_PER_LANE", "RIGID_NORMALS", "CORNER_OFFSETS"]),
            ("bounds", vec!["ORIENTED_BOUNDS"]),
            ("apply", vec![])
        ]
    );
    assert_eq!(minimal.bytes(BufferRole::Tangents) + minimal.bytes(BufferRole::RestTangents), 0);
    assert_eq!((minimal.bytes(BufferRole::ModeWords), minimal.bytes(BufferRole::Scales)), (0, 0));
    assert_eq!(minimal.bytes_in, 112 + 48 * 4, "a header and four transforms, but no q");
    let omitted: Vec<_> = minimal.omitted.iter().map(|omitted| omitted.feature).collect();
    let never_used = ["exact_normals", "compensated", "followers", "displacements", "boxes", "batches"];
    assert_eq!(omitted, [&["modes", "normal_maps", "shear"][..], &never_used].concat());
    // Shapes have 9 + 302 = 311 corners, domains twice as many.
    assert_eq!(minimal.omitted[1].bytes, 16 * (311 + 622), "`normal_maps`: rest and world tangents of every corner");
}

#[test]
fn used_features_are_compiled_and_stored() {
    let full = plan(&scene_with_normal_map(&[(7, 2), (300, 0)]));
    assert_eq!(
        full.kernels[0].defines,
        ["MODES", "ONE_ITEM_PER_LANE", "AXIS_PER_WARP", "RIGID_NORMALS", "CORNER_OFFSETS", "NORMAL_MAPS", "SHEAR"]
    );
    assert_eq!(full.bytes(BufferRole::Tangents), 16 * 2 * (9 + 302));
    assert_eq!(full.bytes(BufferRole::RestTangents), 64 * (3 + 76), "64 bytes per quad of four corners");
    assert_eq!(full.bytes_in, 112 + 48 * 4 + 4 * 4, "a header, four transforms and four coordinates");
    // Of the ten optional features, this scene uses modes, normal maps, shear and shadows.
    assert_eq!(full.omitted.len(), 6);
}

#[test]
fn followers_upload_no_transforms_but_keep_frames() {
    let sizes = [(7, 2), (300, 0)];
    let independent = plan(&rigid_scene(&sizes));
    let followers = plan(&scene_with_followers(&sizes, DeformationSettings::default()));
    assert_eq!(independent.bytes_in, 112 + 48 * 4 + 4 * 4);
    assert_eq!(followers.bytes_in, 112 + 48 + 4 * 4, "three of four domains follow");
    assert_eq!(followers.bytes(BufferRole::FollowerFrames), 8 * 4 + 48 * 3, "four links and three frames");
    assert_eq!(independent.bytes(BufferRole::FollowerFrames), 0);
    let count_macros =
        |plan: &DeformPlan| defines(plan).iter().filter(|(_, macros)| macros.contains(&"FOLLOWERS")).count();
    assert_eq!((count_macros(&independent), count_macros(&followers)), (0, 2), "in `deform` and `apply`");
    assert_eq!(followers.launches(), independent.launches());
}

#[test]
fn storage_selects_the_bytes_and_the_macro_of_u() {
    let bytes = |storage| {
        let plan = plan(&scene_with_storage(&[(300, 8)], storage));
        assert_eq!(plan.kernels[0].defines.last().copied(), storage_define(storage).or(Some("SHEAR")));
        plan.bytes(BufferRole::ModeWords)
    };
    // 75 quads of 48 bytes per chunk. Eight modes are eight, four, four and two chunks.
    assert_eq!(StorageType::ALL.map(bytes), [75 * 48 * 8, 75 * 48 * 4, 75 * 48 * 4, 75 * 48 * 2]);
}

#[test]
fn exact_normals_add_a_kernel_and_its_tables() {
    let scene = scene_with_exact_normals(&[(7, 2), (300, 0), (513, 4)]);
    let (plan, rings) = (plan(&scene), RingTables::new(&scene));
    let normals = plan.kernel(KernelKind::Normals).expect("the kernel `normals`");
    assert_eq!((normals.name, normals.defines.as_slice()), ("normals", ["SHEAR"].as_slice()));
    assert_eq!(plan.kernels[0].defines, ["MODES", "ONE_ITEM_PER_LANE", "AXIS_PER_WARP"]);
    assert_eq!(plan.launches(), 4, "a partial step launches `apply`, `deform`, `bounds` and `normals`");
    for (role, bytes) in [
        (BufferRole::CornerSlots, size_of_val(super::super::rings::normal_slots(&scene).as_slice())),
        (BufferRole::CornerGroups, size_of_val(rings.corner_groups.as_slice())),
        (BufferRole::RingTables, size_of_val(rings.ring_offsets.as_slice()) + size_of_val(rings.rings.as_slice())),
        (BufferRole::GroupNormals, size_of_val(rings.group_normals.as_slice())),
    ] {
        assert_eq!(plan.bytes(role), bytes as u64, "{role:?}");
    }
    assert_eq!(plan.bytes(BufferRole::CornerGroups), 4 * (9 + 515), "the shape without modes has no groups");
    let rigid = super::plan(
        &scene_with_storage(&[(7, 2), (300, 0), (513, 4)], StorageType::F32),
        CudaDeformerOptions::default(),
    );
    assert_eq!(
        rigid.bytes(BufferRole::CornerGroups)
            + rigid.bytes(BufferRole::RingTables)
            + rigid.bytes(BufferRole::GroupNormals),
        0
    );
    let omitted = rigid.omitted.iter().find(|omitted| omitted.feature == "exact_normals").expect("an omitted feature");
    assert_eq!(omitted.bytes, 4 * (9 + 515) + 20 * 6, "corner groups, and slots of six domains");
}

#[test]
fn readbacks_add_buffers_and_macros_but_no_kernels() {
    let sizes = [(7, 2), (300, 0)];
    let without_readbacks = plan(&scene_with_storage(&sizes, StorageType::F32));
    let with_readbacks = plan(&scene_with_readbacks(&sizes));
    let roles = [BufferRole::Displacements, BufferRole::BoxSegments, BufferRole::DomainBoxes];
    // Four domains have one segment of 16 bytes each, and one box of 24 bytes per segment: 40 bytes together.
    assert_eq!(roles.map(|role| without_readbacks.bytes(role)), [0; 3]);
    assert_eq!(roles.map(|role| with_readbacks.bytes(role)), [12 * 2 * (7 + 300), 16 * 4, 24 * 4]);
    assert_eq!(with_readbacks.total_bytes() - without_readbacks.total_bytes(), 12 * 2 * (7 + 300) + 40 * 4);
    assert!(
        without_readbacks
            .kernels
            .iter()
            .all(|kernel| !kernel.defines.iter().any(|name| READBACK_DEFINES.contains(name)))
    );
    let count_macros = |kernel: usize| {
        with_readbacks.kernels[kernel].defines.iter().filter(|name| READBACK_DEFINES.contains(name)).count()
    };
    // Kernels 0, 1 and 2 are `deform`, `bounds` and `apply`.
    assert_eq!([count_macros(0), count_macros(1), count_macros(2)], [1, 1, 0]);
    assert_eq!(
        (with_readbacks.launches(), with_readbacks.bytes_in, with_readbacks.bytes_out),
        (without_readbacks.launches(), without_readbacks.bytes_in, without_readbacks.bytes_out)
    );
    let omitted_bytes =
        |name: &str| without_readbacks.omitted.iter().find(|omitted| omitted.feature == name).map(|part| part.bytes);
    assert_eq!([omitted_bytes("displacements"), omitted_bytes("boxes")], [Some(12 * 2 * (7 + 300)), Some(40 * 4)]);
}

/// The macros of displacements (in `deform`) and boxes (in `bounds`).
const READBACK_DEFINES: [&str; 2] = ["DISPLACEMENTS", "DOMAIN_BOXES"];

#[test]
fn shadow_adds_oriented_bounds_but_no_kernel() {
    let sizes = [(7, 2), (300, 0)];
    let (with_shadow, without_shadow) =
        (plan(&scene_with_storage(&sizes, StorageType::F32)), plan(&scene_without_shadow(&sizes)));
    let defines = |plan: &DeformPlan| plan.kernel(KernelKind::Bounds).expect("the kernel `bounds`").defines.clone();
    assert_eq!((defines(&with_shadow), defines(&without_shadow)), (vec!["ORIENTED_BOUNDS"], vec![]));
    assert_eq!((with_shadow.bytes_out, without_shadow.bytes_out), (48, 24));
    assert_eq!(
        (with_shadow.launches(), with_shadow.total_bytes()),
        (without_shadow.launches(), without_shadow.total_bytes())
    );
    let omits_shadow = |plan: &DeformPlan| plan.omitted.iter().any(|omitted| omitted.feature == "shadows");
    assert!(omits_shadow(&without_shadow) && !omits_shadow(&with_shadow));
}

#[test]
fn launches_do_not_grow_with_the_number_of_domains() {
    let (two_domains, many_domains) = (scene(&[(7, 1)]), scene(&[(7, 1); 3000]));
    // Two domains are too few for partial steps, which launch `apply`.
    assert_eq!((plan(&two_domains).launches(), plan(&many_domains).launches()), (2, 3));
}

#[test]
fn scenes_without_partial_steps_have_no_change_lists() {
    let has_lists = |scene: &Scene| {
        let plan = plan(scene);
        assert_eq!(plan.kernel(KernelKind::Apply).is_some(), plan.change_list_bytes > 0);
        plan.change_list_bytes > 0
    };
    // Two instances of each shape.
    assert!(!has_lists(&scene(&[(7, 1)])), "a quarter of two domains is less than one domain");
    assert!(has_lists(&scene(&[(7, 1), (7, 1)])));
}

#[test]
fn planned_bytes_equal_the_bytes_of_the_tables() {
    let scene = scene_with_normal_map(&[(7, 2), (300, 0), (513, 4)]);
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
