//! Tests of the physics process against a fake server: its model matches the server's description, and subscribers of
//! the server receive the motion that it computes.

#[path = "../../rust/tests/fake/mod.rs"]
#[allow(dead_code, reason = "shared with the tests of the client")]
mod fake;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use fake::{FakeDomain, FakeServer, IDENTITY, pack, serve};
use modalcast_client::{Client, VertexSelection, VertexStreamRequest};

/// A beam of length 1 along y with two bending modes. Each of its sections has six vertices.
fn beam(index: u32, radius: f32) -> FakeDomain {
    let (mut rest, mut modes) = (vec![], vec![]);
    for level in 0..9 {
        let y = level as f32 / 8.0;
        for corner in 0..6 {
            let angle = corner as f32 * std::f32::consts::PI / 3.0;
            let (x, z) = (radius * angle.cos(), radius * angle.sin());
            rest.extend([x, y, z]);
            modes.extend([y * y, 0.0, -2.0 * y * x, -2.0 * y * z, 0.0, y * y]);
        }
    }
    FakeDomain::new(index, rest, 2, modes)
}

/// A trunk, two generations of tilted branches, each at the tip ring of the previous part, and a rigid leaf.
fn plant() -> FakeServer {
    let (sine, cosine) = (0.6_f32, 0.8_f32);
    let frame = [cosine, sine, 0.0, 0.0, -sine, cosine, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0];
    let mut domains = vec![];
    let mut placement = IDENTITY;
    for index in 0..4 {
        let radius = 0.05 / (index + 1) as f32;
        let mut domain = beam(index, radius);
        if index == 3 {
            domain = FakeDomain::new(3, vec![0.0, 0.0, 0.0, 0.1, 0.2, 0.0, -0.1, 0.2, 0.0], 0, vec![]);
        }
        if index > 0 {
            placement = product(&placement, &frame);
            domain.wire.parent = Some(index - 1);
            domain.wire.attachment_frame = pack(&frame).into();
            domain.wire.attachment_rows = (48..54).collect();
        }
        domain.wire.placement = pack(&placement).into();
        let square = |hertz: f64| (2.0 * std::f64::consts::PI * hertz).powi(2);
        if index < 3 {
            domain.wire.eigenvalues = vec![square(0.9), square(1.1)];
            domain.wire.notes.insert("damping_ratio".into(), "0.05".into());
        }
        domains.push(domain);
    }
    FakeServer::new(domains)
}

fn product(a: &[f32; 12], b: &[f32; 12]) -> [f32; 12] {
    std::array::from_fn(|at| {
        let (row, column) = (at / 4, at % 4);
        let sum: f32 = (0..3).map(|k| a[4 * row + k] * b[4 * k + column]).sum();
        sum + if column == 3 { a[4 * row + 3] } else { 0.0 }
    })
}

/// Runs `modalcast-sim`. Returns its exit code, standard output and standard error.
async fn sim(url: &str, arguments: &[&str]) -> (i32, String, String) {
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_modalcast-sim"));
    command.args(arguments).args(["--server", url]);
    let output = tokio::task::spawn_blocking(move || command.output().expect("starts")).await.expect("ends");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.code().unwrap_or(-1), text(&output.stdout), text(&output.stderr))
}

fn summary(out: &str) -> serde_json::Value {
    serde_json::from_str(out).expect("one line of JSON")
}

/// The numbers of a `.npy` file with the 128-byte header that the recorder writes.
fn numbers(path: &Path) -> Vec<f32> {
    fake::floats(&std::fs::read(path).expect("a record")[128..])
}

fn distance(positions: &[f32], a: usize, b: usize) -> f64 {
    let square = |c| f64::from(positions[3 * a + c] - positions[3 * b + c]).powi(2);
    (0..3).map(square).sum::<f64>().sqrt()
}

#[tokio::test(flavor = "multi_thread")]
async fn tree_sways_and_subscribers_receive_closed_joints() {
    let world = Arc::new(plant());
    let url = serve(Arc::clone(&world)).await;
    let client = Client::connect(&url).await.expect("connects");
    let rest = world.now().positions;
    let request = VertexStreamRequest::new("toy", VertexSelection::default()).replies(90);
    let mut sets = client.stream_vertices(&request).await.expect("accepted");
    let folder = tempfile::tempdir().expect("folder");
    let record = folder.path().display().to_string();
    let arguments = ["tree", "--scene", "toy", "--steps", "90", "--json", "--record", &record];
    let (code, out, fault) = sim(&url, &arguments).await;
    assert_eq!(code, 0, "{fault}");
    let summary = summary(&out);
    assert_eq!((summary["steps_sent"].as_u64(), summary["rejected"].as_u64()), (Some(90), Some(0)));
    let sway = summary["crown_sway_of_height"].as_f64().expect("a number");
    assert!((0.03..0.1).contains(&sway), "{sway}");
    assert!(summary["joint_gap_of_diagonal"].as_f64().expect("a number") <= 1e-3);
    assert_eq!(summary["stages_ms"]["deform"].as_f64(), Some(1.5));
    // Each beam has 54 vertices; the first section of a child is at the last section of its parent.
    let (q, poses) = (numbers(&folder.path().join("q.npy")), numbers(&folder.path().join("transforms.npy")));
    assert_eq!((q.len(), poses.len()), (90 * 6, 90 * 4 * 12));
    let diagonal = (0..3).map(|c| (world.bounds[c + 3] - world.bounds[c]).powi(2)).sum::<f64>().sqrt();
    let (mut gap, mut peak) = (0.0_f64, 0.0_f64);
    for step in 0..90 {
        let set = sets.next().await.expect("a set").expect("whole");
        assert_eq!(set.step.number, step);
        for child in 1..4 {
            for corner in 0..6 {
                let (above, below) = (54 * (child - 1) + 48 + corner, 54 * child);
                gap = gap.max((distance(&set.positions, above, below) - distance(&rest, above, below)).abs());
            }
        }
        let moved = set.positions.iter().zip(&rest).map(|(now, rest)| f64::from((now - rest).abs()));
        peak = peak.max(moved.fold(0.0, f64::max));
    }
    assert!(gap <= 1e-3 * diagonal, "joints open by {gap} of {diagonal}");
    assert!(peak >= 0.03 * diagonal, "the tree hardly moves: {peak} of {diagonal}");
    let sent = world.steps.lock().expect("lock");
    assert_eq!(sent[0].transform_domains, [0, 1, 2, 3]);
    assert!(sent[5..].iter().all(|step| !step.transform_domains.contains(&0)), "a trunk that stands is sent again");
    let first: Vec<f32> = fake::floats(&sent[40].q);
    assert_eq!(first, q[40 * 6..41 * 6]);
}

#[tokio::test(flavor = "multi_thread")]
async fn auto_selects_tree_sweep_or_rocking_by_scene() {
    let mut bare = plant();
    bare.domains.iter_mut().for_each(|domain| domain.wire.eigenvalues.clear());
    let stone = vec![-1.0, 0.0, -1.0, 1.0, 2.0, 1.0, 0.0, 1.0, 0.0];
    let rigid = FakeServer::new(vec![FakeDomain::new(0, stone, 0, vec![])]);
    for (world, name) in [(plant(), "tree"), (bare, "sweep"), (rigid, "sweep")] {
        let world = Arc::new(world);
        let rest = world.now().positions;
        let url = serve(Arc::clone(&world)).await;
        let arguments = ["auto", "--scene", "toy", "--open", "toy", "--steps", "25", "--policy", "latest", "--json"];
        let (code, out, fault) = sim(&url, &arguments).await;
        assert!(code == 0 && fault.contains(name), "{fault}");
        assert_eq!(summary(&out)["steps_sent"].as_u64(), Some(25));
        assert_ne!(world.now().positions, rest, "{name} does not move");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn errors_exit_with_documented_codes() {
    let url = serve(Arc::new(plant())).await;
    assert_eq!(sim(&url, &["tree", "--scene", "none"]).await.0, 1);
    assert_eq!(sim(&url, &["tree", "--dt", "0"]).await.0, 2);
    assert_eq!(sim("http://127.0.0.1:1", &["tree"]).await.0, 3);
    assert_eq!(sim(&url, &["bridge", "--scene", "toy", "--cubic", "/nowhere.cub"]).await.0, 4);
    let (code, _, fault) = sim(&url, &["bridge", "--scene", "toy"]).await;
    assert!(code == 5 && fault.contains("--cubic"), "{fault}");
}

/// The folder of a real Vega model.
fn vega(name: &str) -> PathBuf {
    let beside = concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data");
    let data: PathBuf = std::env::var_os("MODALCAST_DATA").map_or_else(|| beside.into(), Into::into);
    data.join("vega").join(name)
}

/// A domain with the `v` positions of the OBJ file in file order, and U of the `.URendering.float` file, row-major.
fn rendered(name: &str) -> FakeDomain {
    let text = std::fs::read_to_string(vega(name).join(format!("{name}.obj"))).expect("reads");
    let positions = text.lines().filter_map(|line| line.strip_prefix("v "));
    let rest: Vec<f32> = positions
        .flat_map(|line| line.split_whitespace().take(3).map(|number| number.parse().expect("a number")))
        .collect();
    let file = std::fs::read(vega(name).join(format!("{name}.URendering.float"))).expect("reads");
    let size = |at: usize| i32::from_le_bytes(file[at..at + 4].try_into().expect("four bytes")) as usize;
    let (rows, columns, entries) = (size(0), size(4), fake::floats(&file[8..]));
    assert_eq!(rows, rest.len());
    let modes = (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column)));
    FakeDomain::new(0, rest, columns as u32, modes.map(|(row, column)| entries[column * rows + row]).collect())
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
async fn real_models_deflect_as_requested_and_stay_bounded() {
    for (name, first) in [("simpleBridge", 0.25), ("A", 37.68 * 0.02)] {
        let world = Arc::new(FakeServer::new(vec![rendered(name)]));
        let url = serve(Arc::clone(&world)).await;
        let files = vega(name).display().to_string();
        for dt in ["0.0166667", "1"] {
            let arguments = ["auto", "--scene", "toy", "--files", &files, "--steps", "60", "--dt", dt, "--json"];
            let (code, out, fault) = sim(&url, &arguments).await;
            assert!(code == 0 && fault.contains("bridge"), "{fault}");
            let summary = summary(&out);
            let number = |field: &str| summary[field].as_f64().expect("a number");
            assert!((number("deflection_of_diagonal") - 0.03).abs() <= 1e-4, "{summary}");
            assert!((0.02..0.3).contains(&number("peak_of_diagonal")), "{summary}");
            let lowest = summary["frequencies_hz"][0].as_f64().expect("a number");
            assert!((lowest / first - 1.0).abs() <= 1e-3, "{lowest} Hz");
            println!("{name} dt {dt}: {summary}");
        }
    }
}
