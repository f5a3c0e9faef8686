//! Leaves that follow their branch, over the wire.

use modalcast_proto::v1;

use crate::service_harness::{Server, get_vertices, reference_vertices, step, twig};

const BRANCH: u32 = 1;
const LEAF: u32 = 2;
const LEAFLET: u32 = 3;

/// A step that moves domains; each row is a 3 x 4 matrix of 12 numbers.
fn moved(number: u64, domains: &[u32], rows: &[[f32; 12]]) -> v1::Step {
    let transforms = rows.as_flattened().iter().flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>().into();
    v1::Step { transform_domains: domains.to_vec(), transforms, ..step(number, &[], &[]) }
}

fn ask(domains: &[u32]) -> v1::GetVerticesRequest {
    let selection = Some(v1::VertexSelection { domains: domains.to_vec(), positions_only: true, ..Default::default() });
    v1::GetVerticesRequest { scene: "twig".into(), selection, ..v1::GetVerticesRequest::default() }
}

const TURN: [f32; 12] = [0.0, -1.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, -3.0];
const SHIFT: [f32; 12] = [1.0, 0.0, 0.0, 7.0, 0.0, 1.0, 0.0, 8.0, 0.0, 0.0, 1.0, 9.0];

#[tokio::test(flavor = "multi_thread")]
async fn moved_branch_moves_only_its_leaves() {
    let server = Server::start_default().await;
    server.open("twig").await;
    let mut driver = server.drive("twig", v1::Policy::Lossless, 0).await;
    let at_rest = get_vertices(&server, ask(&[])).await.expect("vertices").positions;
    let step = moved(0, &[BRANCH], &[TURN]);
    driver.step_acknowledged(step.clone()).await;
    let got = get_vertices(&server, ask(&[])).await.expect("vertices").positions;
    assert_eq!(got, reference_vertices(&twig(), &[step]).0);
    assert_eq!(got[..12], at_rest[..12], "the other strip stays");
    // The first vertex of the leaf is the origin of the leaf's frame, which is at (0.5, 1, -0.25) in the branch's
    // frame. The leaflet applies the same frame again within the leaf's frame.
    let turned = |[x, y, z]: [f32; 3]| [2.0 - y, x, z - 3.0];
    let first = |domain: usize| [got[12 * domain], got[12 * domain + 1], got[12 * domain + 2]];
    assert_eq!(first(LEAF as usize), turned([0.5, 1.0, -0.25]));
    assert_eq!(first(LEAFLET as usize), turned([-0.5, 1.5, -0.5]));
    assert!((1..4).all(|domain| got[12 * domain..][..12] != at_rest[12 * domain..][..12]), "negative control");
    driver.finish().await;
}

/// A step without a list has one transform for each transform root. A step that contains the transform of a follower is
/// refused and none of it is applied.
#[tokio::test(flavor = "multi_thread")]
async fn transform_of_a_follower_is_refused_whole() {
    let server = Server::start_default().await;
    server.open("twig").await;
    let mut driver = server.drive("twig", v1::Policy::Lossless, 0).await;
    // Transforms without a list of domains are those of both strips; the two followers have none.
    let all = moved(0, &[], &[SHIFT, TURN]);
    driver.step_acknowledged(all.clone()).await;
    let got = get_vertices(&server, ask(&[])).await.expect("vertices").positions;
    assert_eq!(got, reference_vertices(&twig(), &[all]).0);
    let wrong = v1::Step { q_domains: vec![0], q: vec![1; 8].into(), ..moved(1, &[BRANCH, LEAFLET], &[SHIFT, TURN]) };
    driver.step(wrong).await;
    let refusal = driver.rejection().await;
    assert_eq!(
        (refusal.field.as_str(), refusal.expected.as_str(), refusal.given.as_str()),
        ("step.transform_domains[1]", "a domain with a transform of its own", "3 ('leaflet'), which follows 'right'")
    );
    assert_eq!(get_vertices(&server, ask(&[])).await.expect("vertices").positions, got, "nothing was applied");
    driver.finish().await;
    // A follower has coordinates of its own: only the leaf bends.
    let mut driver = server.drive("twig", v1::Policy::Lossless, 0).await;
    driver.step_acknowledged(step(2, &[LEAF], &[0.5, -0.25])).await;
    let bent = get_vertices(&server, ask(&[])).await.expect("vertices").positions;
    assert!(bent[..24] == got[..24] && bent[24..36] != got[24..36] && bent[36..] == got[36..]);
    driver.finish().await;
}
