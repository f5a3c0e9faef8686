//! Followers over the wire: a leaf that follows a branch, and a leaflet that follows the leaf. A follower has a fixed
//! frame relative to its parent. A domain that follows no other domain is a transform root and has a transform of its
//! own.

use modalcast_proto::v1;

use crate::service_harness::{Server, get_vertices, reference_vertices, select, step, twig};

/// Indices of domains of the scene `twig`, where the branch is named `right`. Domain 0, `left`, is a strip that no
/// domain follows.
const BRANCH: u32 = 1;
const LEAF: u32 = 2;
const LEAFLET: u32 = 3;

/// A step that sets the transforms of the listed domains, or of all transform roots if the list is empty. Each
/// transform is a row-major 3 x 4 matrix.
fn transform_step(number: u64, domains: &[u32], transforms: &[[f32; 12]]) -> v1::Step {
    let transforms =
        transforms.as_flattened().iter().flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>().into();
    v1::Step { transform_domains: domains.to_vec(), transforms, ..step(number, &[], &[]) }
}

fn vertex_request(domains: &[u32]) -> v1::GetVerticesRequest {
    let selection = select(domains, &[v1::Attribute::Positions]);
    v1::GetVerticesRequest { scene: "twig".into(), selection, ..v1::GetVerticesRequest::default() }
}

/// Numbers of the positions of a domain: four vertices times three axes.
const NUMBERS_PER_DOMAIN: usize = 12;

/// Row-major 3 x 4 matrix: a rotation by 90 degrees about z, then a translation by (2, 0, -3).
const ROTATION_AND_SHIFT: [f32; 12] = [0.0, -1.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, -3.0];
/// Row-major 3 x 4 matrix: a translation by (7, 8, 9).
const TRANSLATION: [f32; 12] = [1.0, 0.0, 0.0, 7.0, 0.0, 1.0, 0.0, 8.0, 0.0, 0.0, 1.0, 9.0];

#[tokio::test(flavor = "multi_thread")]
async fn moved_branch_moves_only_itself_and_its_followers() {
    let server = Server::start_default().await;
    server.open("twig").await;
    let mut writer = server.drive_lossless("twig").await;
    let rest_positions = get_vertices(&server, vertex_request(&[])).await.expect("expected vertices").positions;
    let step = transform_step(0, &[BRANCH], &[ROTATION_AND_SHIFT]);
    writer.send_step_and_wait(step.clone()).await;
    let positions = get_vertices(&server, vertex_request(&[])).await.expect("expected vertices").positions;
    assert_eq!(positions, reference_vertices(&twig(), &[step]).positions);
    assert_eq!(positions[..NUMBERS_PER_DOMAIN], rest_positions[..NUMBERS_PER_DOMAIN], "expected domain 0 not to move");
    // The first vertex of the leaf is the origin of the leaf's frame, which is at (0.5, 1, -0.25) in the branch's
    // frame. The leaflet has the same frame relative to the leaf. The frame maps (0.5, 1, -0.25) to (-0.5, 1.5, -0.5).
    let transformed = |[x, y, z]: [f32; 3]| [2.0 - y, x, z - 3.0];
    let positions_of = |domain: usize| &positions[NUMBERS_PER_DOMAIN * domain..][..NUMBERS_PER_DOMAIN];
    let first_vertex = |domain: usize| [positions_of(domain)[0], positions_of(domain)[1], positions_of(domain)[2]];
    assert_eq!(first_vertex(LEAF as usize), transformed([0.5, 1.0, -0.25]));
    assert_eq!(first_vertex(LEAFLET as usize), transformed([-0.5, 1.5, -0.5]));
    assert!(
        (1..4)
            .all(|domain| *positions_of(domain) != rest_positions[NUMBERS_PER_DOMAIN * domain..][..NUMBERS_PER_DOMAIN]),
        "negative control: the branch and its followers move"
    );
    writer.finish().await;
}

/// A step with the transform of a follower is rejected as a whole. A step without a list of domains has one transform
/// per transform root, and none for followers.
#[tokio::test(flavor = "multi_thread")]
async fn step_with_transform_of_a_follower_is_rejected() {
    let server = Server::start_default().await;
    server.open("twig").await;
    let mut writer = server.drive_lossless("twig").await;
    // The transform roots are domain 0 and the branch.
    let root_step = transform_step(0, &[], &[TRANSLATION, ROTATION_AND_SHIFT]);
    writer.send_step_and_wait(root_step.clone()).await;
    let positions = get_vertices(&server, vertex_request(&[])).await.expect("expected vertices").positions;
    assert_eq!(positions, reference_vertices(&twig(), &[root_step]).positions);
    // The coordinates q of domain 0 are valid (`vec![1; 8]` is two small f32), but must not be applied either.
    let invalid_step = v1::Step {
        q_domains: vec![0],
        q: vec![1; 8].into(),
        ..transform_step(1, &[BRANCH, LEAFLET], &[TRANSLATION, ROTATION_AND_SHIFT])
    };
    writer.send_step(invalid_step).await;
    let rejection = writer.receive_rejection().await;
    assert_eq!(
        (rejection.field.as_str(), rejection.expected.as_str(), rejection.given.as_str()),
        ("step.transform_domains[1]", "a domain with a transform of its own", "3 ('leaflet'), which follows 'right'")
    );
    assert_eq!(
        get_vertices(&server, vertex_request(&[])).await.expect("expected vertices").positions,
        positions,
        "expected no change by a rejected step"
    );
    writer.finish().await;
    // A follower has its own coordinates: the step deforms only the leaf.
    let mut writer = server.drive_from_current_state("twig").await;
    writer.send_step_and_wait(step(2, &[LEAF], &[0.5, -0.25])).await;
    let deformed_positions = get_vertices(&server, vertex_request(&[])).await.expect("expected vertices").positions;
    let leaf = NUMBERS_PER_DOMAIN * LEAF as usize..NUMBERS_PER_DOMAIN * LEAFLET as usize;
    assert!(
        deformed_positions[..leaf.start] == positions[..leaf.start]
            && deformed_positions[leaf.clone()] != positions[leaf.clone()]
            && deformed_positions[leaf.end..] == positions[leaf.end..]
    );
    writer.finish().await;
}
