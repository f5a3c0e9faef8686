//! Tests of the physics process against a fake server. Subscribers of the server receive the motion that the process
//! computes.

#[path = "../../../rust/tests/fake/mod.rs"]
#[allow(dead_code, reason = "shared with the tests of the client")]
mod fake;
mod free;
mod resume;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use fake::{FakeDomain, FakeServer, IDENTITY, compose, pack, serve};
use modalcast_client::{Client, VertexSelection, VertexStreamRequest, v1};

/// A beam of length 1 along y with two bending modes: nine sections of six vertices, 54 vertices in all.
fn beam(index: u32, radius: f32) -> FakeDomain {
    let (mut rest_positions, mut modes) = (vec![], vec![]);
    for section in 0..9 {
        let y = section as f32 / 8.0;
        for vertex in 0..6 {
            let angle = vertex as f32 * std::f32::consts::PI / 3.0;
            let (x, z) = (radius * angle.cos(), radius * angle.sin());
            rest_positions.extend([x, y, z]);
            modes.extend([y * y, 0.0, -2.0 * y * x, -2.0 * y * z, 0.0, y * y]);
        }
    }
    FakeDomain::new(index, rest_positions, 2, modes)
}

/// A server with a trunk, a branch, a branch of this branch, and a rigid leaf. Each domain but the trunk is tilted and
/// attached to the last section of the previous domain.
fn tree_server() -> FakeServer {
    // A rotation about z by -atan(0.6 / 0.8), and a translation to the end of the parent, (0, 1, 0).
    let (sine, cosine) = (0.6_f32, 0.8_f32);
    let parent_from_child = [cosine, sine, 0.0, 0.0, -sine, cosine, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0];
    let mut domains = vec![];
    let mut placement = IDENTITY.to_vec();
    for index in 0..4 {
        let radius = 0.05 / (index + 1) as f32;
        let mut domain = beam(index, radius);
        if index == 3 {
            // The leaf: one triangle without modes.
            domain = FakeDomain::new(3, vec![0.0, 0.0, 0.0, 0.1, 0.2, 0.0, -0.1, 0.2, 0.0], 0, vec![]);
        }
        if index > 0 {
            placement = compose(&placement, &parent_from_child);
            domain.wire.parent = Some(index - 1);
            domain.wire.attachment_frame = pack(&parent_from_child).into();
            // The last of the nine sections.
            domain.wire.attachment_vertices = (48..54).collect();
        }
        domain.wire.placement = pack(&placement).into();
        let eigenvalue = |hertz: f64| (2.0 * std::f64::consts::PI * hertz).powi(2);
        if index < 3 {
            domain.shape.eigenvalues = vec![eigenvalue(0.9), eigenvalue(1.1)];
            domain.wire.notes.insert("damping_ratio".into(), "0.05".into());
        }
        domains.push(domain);
    }
    FakeServer::new(domains)
}

/// The result of a run of `modalcast-sim`.
struct SimOutput {
    exit_code: i32,
    stdout: String,
    stderr: String,
}

impl SimOutput {
    /// The report on standard output.
    fn report(&self) -> serde_json::Value {
        serde_json::from_str(&self.stdout).expect("one line of JSON")
    }
}

/// Runs `modalcast-sim` with a server.
async fn run_sim(url: &str, arguments: &[&str]) -> SimOutput {
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_modalcast-sim"));
    command.args(arguments).args(["--server", url]);
    let run = tokio::task::spawn_blocking(move || command.output().expect("modalcast-sim to start"));
    let output = run.await.expect("modalcast-sim to end");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    SimOutput {
        exit_code: output.status.code().unwrap_or(-1),
        stdout: text(&output.stdout),
        stderr: text(&output.stderr),
    }
}

/// The numbers of a `.npy` file with the 128-byte header that the recorder writes.
fn read_npy(path: &Path) -> Vec<f32> {
    fake::decode_f32(&std::fs::read(path).expect("a record")[128..])
}

/// The distance between the vertices `a` and `b`.
fn distance(positions: &[f32], a: usize, b: usize) -> f64 {
    let square = |axis| f64::from(positions[3 * a + axis] - positions[3 * b + axis]).powi(2);
    (0..3).map(square).sum::<f64>().sqrt()
}

#[tokio::test(flavor = "multi_thread")]
async fn tree_sways_and_subscribers_receive_closed_joints() {
    let server = Arc::new(tree_server());
    let url = serve(Arc::clone(&server)).await;
    let client = Client::connect(&url).await.expect("a connection");
    let rest_positions = server.output().positions;
    // `toy` is the only scene of the fake server.
    let request = VertexStreamRequest::new("toy", VertexSelection::default()).max_steps(90);
    let mut vertex_stream = client.stream_vertices(&request).await.expect("a stream");
    let folder = tempfile::tempdir().expect("a temporary folder");
    let record = folder.path().display().to_string();
    let sim_output = run_sim(&url, &["toy", "--wind", "4", "--steps", "90", "--json", "--record", &record]).await;
    assert_eq!(sim_output.exit_code, 0, "{}", sim_output.stderr);
    let report = sim_output.report();
    assert_eq!((report["steps_sent"].as_u64(), report["rejected"].as_u64()), (Some(90), Some(0)));
    let sway = report["crown_sway_of_height"].as_f64().expect("a number");
    assert!((0.003..0.3).contains(&sway), "{sway}");
    assert!(report["wind_force_peak_n"].as_f64().is_some_and(|force| force > 0.1), "{report}");
    assert!(report["joint_gap_of_diagonal"].as_f64().expect("a number") <= 1e-3);
    // The fake server reports 1.5 ms for every step.
    assert_eq!(report["stages_ms"]["deform"].as_f64(), Some(1.5));
    let (q, transforms) = (read_npy(&folder.path().join("q.npy")), read_npy(&folder.path().join("transforms.npy")));
    // 90 steps of six coordinates and four 3x4 transforms.
    assert_eq!((q.len(), transforms.len()), (90 * 6, 90 * 4 * 12));
    let bounds = &server.bounds;
    let diagonal = (0..3).map(|axis| (bounds[axis + 3] - bounds[axis]).powi(2)).sum::<f64>().sqrt();
    let (mut max_gap, mut peak_displacement) = (0.0_f64, 0.0_f64);
    for step in 0..90 {
        let vertex_set = vertex_stream.next().await.expect("a set of vertices").expect("a valid set");
        assert_eq!(vertex_set.step.number, step);
        // A child's first vertex is at the last section of its parent. Every domain but the last has 54 vertices.
        for child in 1..4 {
            for vertex in 0..6 {
                let (parent_vertex, child_vertex) = (54 * (child - 1) + 48 + vertex, 54 * child);
                let rest_distance = distance(&rest_positions, parent_vertex, child_vertex);
                max_gap =
                    max_gap.max((distance(&vertex_set.positions, parent_vertex, child_vertex) - rest_distance).abs());
            }
        }
        let displacements =
            vertex_set.positions.iter().zip(&rest_positions).map(|(current, rest)| f64::from((current - rest).abs()));
        peak_displacement = peak_displacement.max(displacements.fold(0.0, f64::max));
    }
    assert!(max_gap <= 1e-3 * diagonal, "joint gap {max_gap}, diagonal {diagonal}");
    assert!(peak_displacement >= 0.03 * diagonal, "displacement {peak_displacement}, diagonal {diagonal}");
    let steps = server.steps.lock().expect("lock");
    assert_eq!(steps[0].transform_domains, [0, 1, 2, 3]);
    let sends_trunk_transform = steps[5..].iter().any(|step| step.transform_domains.contains(&0));
    assert!(!sends_trunk_transform, "expected no transform of the trunk, which does not change");
    assert_eq!(fake::decode_f32(&steps[40].q), q[40 * 6..41 * 6]);
}

/// The server rejects transforms of the leaf, which follows the last branch.
#[tokio::test(flavor = "multi_thread")]
async fn followers_get_no_transforms_and_move_with_their_leaders() {
    let mut server = tree_server();
    let leaf = &mut server.domains[3].wire;
    (leaf.follows, leaf.follow_frame) = (Some(2), leaf.attachment_frame.clone());
    let server = Arc::new(server);
    let rest_positions = server.output().positions;
    let url = serve(Arc::clone(&server)).await;
    for motion in [&["sweep"][..], &[]] {
        let arguments = [motion, &["--scene", "toy", "--steps", "30", "--json"]].concat();
        let sim_output = run_sim(&url, &arguments).await;
        assert_eq!(sim_output.exit_code, 0, "{}", sim_output.stderr);
        let report = sim_output.report();
        assert_eq!((report["steps_sent"].as_u64(), report["rejected"].as_u64()), (Some(30), Some(0)), "{report}");
    }
    let steps = server.steps.lock().expect("lock");
    assert!(steps.iter().any(|step| step.transform_domains.contains(&2)), "expected transforms of the last branch");
    assert!(!steps.iter().any(|step| step.transform_domains.contains(&3)), "expected no transform of the leaf");
    // The leaf has the last three vertices.
    let positions = server.output().positions;
    assert_ne!(positions[positions.len() - 9..], rest_positions[positions.len() - 9..], "expected the leaf to move");
}

#[tokio::test(flavor = "multi_thread")]
async fn motion_follows_from_the_content_of_the_scene() {
    let mut server_without_eigenvalues = tree_server();
    server_without_eigenvalues.domains.iter_mut().for_each(|domain| domain.shape.eigenvalues.clear());
    let triangle = vec![-1.0, 0.0, -1.0, 1.0, 2.0, 1.0, 0.0, 1.0, 0.0];
    let rigid_server = FakeServer::new(vec![FakeDomain::new(0, triangle, 0, vec![])]);
    // One beam with eigenvalues is no tree.
    let mut beam_server = tree_server();
    beam_server.domains.truncate(1);
    for (server, motion) in [
        (tree_server(), "modes in a wind of "),
        (server_without_eigenvalues, "sweep"),
        (beam_server, "sweep"),
        (rigid_server, "sweep"),
    ] {
        let server = Arc::new(server);
        let rest_positions = server.output().positions;
        let url = serve(Arc::clone(&server)).await;
        let arguments = ["--scene", "toy", "--open", "toy", "--steps", "25", "--delivery", "latest", "--json"];
        let sim_output = run_sim(&url, &arguments).await;
        assert!(sim_output.exit_code == 0 && sim_output.stderr.contains(motion), "{}", sim_output.stderr);
        assert_eq!(sim_output.report()["steps_sent"].as_u64(), Some(25));
        assert_ne!(server.output().positions, rest_positions, "expected positions to change: {motion}");
    }
}

/// Without wind, only the force of a viewer moves the tree. The sweep rejects --forces.
#[tokio::test(flavor = "multi_thread")]
async fn forces_of_viewers_act_on_request() {
    let mut server = tree_server();
    let force = v1::Force { id: 1, domain: 0, kind: None };
    server.forces =
        vec![v1::AppliedForce { owner: 1, force: Some(force), f_q: pack(&[2.0_f32, 0.0]).into(), rest_point: vec![] }];
    let server = Arc::new(server);
    let rest_positions = server.output().positions;
    // Vertex 48 is at the end of the trunk. Its modes move it along x and z, and the force acts on the first one.
    let displacement = || server.output().positions[3 * 48] - rest_positions[3 * 48];
    let url = serve(Arc::clone(&server)).await;
    let arguments = ["--scene", "toy", "--steps", "20", "--wind", "0", "--json"];
    let sim_output = run_sim(&url, &arguments).await;
    assert_eq!(sim_output.exit_code, 0, "{}", sim_output.stderr);
    assert_eq!(displacement(), 0.0, "control: expected no motion without --forces");
    let sim_output = run_sim(&url, &[&arguments[..], &["--forces"]].concat()).await;
    assert_eq!(sim_output.exit_code, 0, "{}", sim_output.stderr);
    assert!(displacement() > 1e-3, "{}", displacement());
    let sim_output = run_sim(&url, &["sweep", "--scene", "toy", "--steps", "2", "--forces"]).await;
    assert!(sim_output.exit_code == 5 && sim_output.stderr.contains("--forces"), "{}", sim_output.stderr);
}

/// A pull at the rigid leaf, which has no coordinates, moves the domains that carry it, up to the trunk.
#[tokio::test(flavor = "multi_thread")]
async fn forces_act_through_joints_on_the_trunk() {
    let mut server = tree_server();
    let surface = v1::SurfaceForce { triangle: 0, barycentric: vec![0.0, 1.0, 0.0], vector: vec![0.0, 0.0, 0.5] };
    let force = v1::Force { id: 1, domain: 3, kind: Some(v1::force::Kind::Surface(surface)) };
    let rest_point = vec![0.1, 0.2, 0.0];
    server.forces = vec![v1::AppliedForce { owner: 1, force: Some(force), f_q: vec![].into(), rest_point }];
    let server = Arc::new(server);
    let url = serve(Arc::clone(&server)).await;
    let arguments = ["--scene", "toy", "--steps", "20", "--wind", "0", "--forces"];
    let sim_output = run_sim(&url, &arguments).await;
    assert_eq!(sim_output.exit_code, 0, "{}", sim_output.stderr);
    let steps = server.steps.lock().expect("lock");
    let q = fake::decode_f32(&steps[19].q);
    // The second mode of every domain moves it along z; the trunk moves by its first one only with torsion, which it
    // does not have.
    assert!(q.len() == 6 && [1, 3, 5].iter().all(|mode| q[*mode] > 1e-3), "{q:?}");
}

/// The mass of a leaf slows the domains that carry it down.
#[tokio::test(flavor = "multi_thread")]
async fn inertia_of_a_leaf_loads_the_trunk() {
    let mut displacements = vec![];
    for mass in [0.0, 5.0] {
        let mut server = tree_server();
        let (center, moments) = (vec![0.0, 0.1, 0.0], vec![0.02 * mass, 0.01 * mass, 0.03 * mass, 0.0, 0.0, 0.0]);
        server.domains[3].wire.inertia = Some(v1::Inertia { mass, center, moments, ..v1::Inertia::default() });
        let force = v1::Force { id: 1, domain: 0, kind: None };
        let f_q = pack(&[0.5_f32, 0.5]).into();
        server.forces = vec![v1::AppliedForce { owner: 1, force: Some(force), f_q, rest_point: vec![] }];
        let server = Arc::new(server);
        let url = serve(Arc::clone(&server)).await;
        let sim_output = run_sim(&url, &["toy", "--steps", "10", "--wind", "0", "--forces"]).await;
        assert_eq!(sim_output.exit_code, 0, "{}", sim_output.stderr);
        let steps = server.steps.lock().expect("lock");
        displacements.push(fake::decode_f32(&steps[9].q)[1]);
    }
    assert!(displacements[0] > 0.0 && displacements[1] < 0.8 * displacements[0], "{displacements:?}");
}

/// `static` reports the displacements of all domains that carry a vertex, and is reciprocal.
#[tokio::test(flavor = "multi_thread")]
async fn static_deflections_are_reported_and_reciprocal() {
    let server = Arc::new(tree_server());
    let url = serve(Arc::clone(&server)).await;
    let run = async |force: &str, at: &str| {
        let sim_output = run_sim(&url, &["static", "toy", "--json", "--force", force, "--at", at]).await;
        assert_eq!(sim_output.exit_code, 0, "{}", sim_output.stderr);
        sim_output.report()
    };
    let numbers = |value: &serde_json::Value| -> Vec<f64> {
        value.as_array().expect("numbers").iter().map(|number| number.as_f64().expect("a number")).collect()
    };
    // Vertex 48 is at the end of a beam, and vertex 2 is a corner of the leaf, domain 3.
    let report = run("3:2:0,0,2", "domain 0:48").await;
    let there = numbers(&report["at"][0]["displacement"]);
    let back = numbers(&run("0:48:0,0,2", "domain 3:2").await["at"][0]["displacement"]);
    assert!(there[2] > 1e-3 && (there[2] / back[2] - 1.0).abs() <= 1e-9, "{there:?} {back:?}");
    let path = report["forces"][0]["path"].as_array().expect("a path");
    assert_eq!(
        path.iter().map(|domain| &domain["domain"]).collect::<Vec<_>>(),
        ["domain 0", "domain 1", "domain 2", "domain 3"]
    );
    // The root does not move, and each domain carries the next one farther.
    let moved: Vec<f64> = path.iter().map(|domain| numbers(&domain["origin_displacement"])[2]).collect();
    assert!(moved[0] == 0.0 && moved.windows(2).all(|pair| pair[1] > pair[0]), "{moved:?}");
    let displacement = numbers(&report["forces"][0]["displacement"]);
    assert!(displacement[2] > moved[3] && report["forces"][0]["force_n"][2] == 2.0, "{report}");
    assert!(server.steps.lock().expect("lock").is_empty(), "expected no step");
    for (force, message) in [
        ("trunk:1:0,0,1", "domain: expected the name of a domain, or an index below 4, got 'trunk'"),
        ("0:54:0,0,1", "vertex of 'domain 0': expected an index below 54, got 54"),
    ] {
        let sim_output = run_sim(&url, &["static", "toy", "--force", force]).await;
        assert!(sim_output.exit_code == 5 && sim_output.stderr.contains(message), "{}", sim_output.stderr);
    }
    assert_eq!(run_sim(&url, &["static", "toy", "--force", "0:1:2"]).await.exit_code, 2);
}

/// A force moves a body that is no tree. Without a stiffness, the process ends with the reason, and sends no step.
#[tokio::test(flavor = "multi_thread")]
async fn forces_move_any_body_with_eigenvalues() {
    type Change<'a> = &'a dyn Fn(&mut FakeDomain);
    let cases: [(Change<'_>, &str); 4] = [
        (&|_| (), ""),
        (&|domain| domain.shape.eigenvalues.clear(), "2 modes without: add the array eigenvalues"),
        (&|domain| domain.shape.eigenvalues.fill(0.0), "'domain 0': q[0] (0 Hz), q[1] (0 Hz)"),
        (&|domain| *domain = FakeDomain::new(0, domain.rest_positions.clone(), 0, vec![]), "no modes"),
    ];
    for (change, reason) in cases {
        let mut domain = tree_server().domains.swap_remove(0);
        change(&mut domain);
        let f_q = vec![2.0_f32; domain.shape.rank as usize];
        let mut server = FakeServer::new(vec![domain]);
        let force = v1::Force { id: 1, domain: 0, kind: None };
        server.forces =
            vec![v1::AppliedForce { owner: 1, force: Some(force), f_q: pack(&f_q).into(), rest_point: vec![] }];
        let server = Arc::new(server);
        let rest_positions = server.output().positions;
        let url = serve(Arc::clone(&server)).await;
        let sim_output = run_sim(&url, &["--scene", "toy", "--steps", "20", "--forces", "--json"]).await;
        if reason.is_empty() {
            assert_eq!(sim_output.exit_code, 0, "{}", sim_output.stderr);
            assert_ne!(server.output().positions, rest_positions, "expected motion");
            assert!(sim_output.report()["load"].as_str().expect("a load").starts_with("calm air"));
            continue;
        }
        let last_line = sim_output.stderr.lines().last().unwrap_or_default();
        assert!(sim_output.exit_code == 5 && last_line.contains(reason), "{}", sim_output.stderr);
        assert!(last_line.contains("eigenvalues") && server.steps.lock().expect("lock").is_empty(), "{last_line}");
    }
}

/// Invalid parameters of modes stop the process before the first step.
#[tokio::test(flavor = "multi_thread")]
async fn invalid_parameters_stop_before_the_first_step() {
    let set_damping = |server: &mut FakeServer, text: &str| {
        server.domains[1].wire.notes.insert("damping_ratio".into(), text.into());
    };
    type Change<'a> = &'a dyn Fn(&mut FakeServer);
    let cases: [(Change<'_>, &str); 4] = [
        (&|server| set_damping(server, "nan"), "damping_ratio"),
        (&|server| set_damping(server, "five"), "damping_ratio"),
        (&|server| server.domains[1].shape.eigenvalues[1] = -40.0, "eigenvalues[1]"),
        (&|server| server.domains[1].shape.eigenvalues = vec![40.0], "eigenvalues"),
    ];
    for (change, field) in cases {
        let mut server = tree_server();
        change(&mut server);
        let server = Arc::new(server);
        let url = serve(Arc::clone(&server)).await;
        let sim_output = run_sim(&url, &["--scene", "toy", "--steps", "3"]).await;
        assert!(sim_output.exit_code == 5 && sim_output.stderr.contains(field), "{}", sim_output.stderr);
        assert!(server.steps.lock().expect("lock").is_empty(), "expected no step");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn fixed_modes_and_unresolved_gusts_are_reported() {
    let mut server = tree_server();
    server.domains[1].shape.eigenvalues[0] = 0.0;
    server.domains[2].wire.notes.insert("rigid_modes".into(), "1".into());
    let url = serve(Arc::new(server)).await;
    let sim_output = run_sim(&url, &["--scene", "toy", "--steps", "3", "--dt", "0.5", "--json"]).await;
    assert_eq!(sim_output.exit_code, 0, "{}", sim_output.stderr);
    let report = sim_output.report();
    let held = "(2; the note rigid_modes sets how many): 'domain 1': q[0] (0 Hz); 'domain 2': q[0] (0.9 Hz)";
    for (index, remark) in [held, "gusts above 1 Hz"].into_iter().enumerate() {
        assert!(sim_output.stderr.contains(remark), "{}", sim_output.stderr);
        assert!(report["remarks"][index].as_str().expect("a remark").contains(remark), "{report}");
    }
}

/// A viewer cannot end the process by an enormous force: the forces of all viewers together bend the scene by a limited
/// fraction of its diagonal.
#[tokio::test(flavor = "multi_thread")]
async fn enormous_forces_bend_the_scene_by_a_limited_amount() {
    let mut server = tree_server();
    let force = v1::Force { id: 1, domain: 1, kind: None };
    server.forces =
        vec![v1::AppliedForce { owner: 1, force: Some(force), f_q: pack(&[0.0, 1e30_f32]).into(), rest_point: vec![] }];
    let server = Arc::new(server);
    let url = serve(Arc::clone(&server)).await;
    let folder = tempfile::tempdir().expect("a temporary folder");
    let record = folder.path().display().to_string();
    let arguments = ["--scene", "toy", "--steps", "20", "--forces", "--record", &record];
    let sim_output = run_sim(&url, &arguments).await;
    assert_eq!(sim_output.exit_code, 0, "{}", sim_output.stderr);
    let steps = server.steps.lock().expect("lock");
    assert_eq!(steps.len(), 20);
    let coordinates: Vec<f32> = steps.iter().flat_map(|step| fake::decode_f32(&step.q)).collect();
    assert!(coordinates.iter().all(|number| number.abs() < 1e3), "{coordinates:?}");
    assert!(coordinates.iter().any(|number| number.abs() > 1e-3), "control: expected motion, got {coordinates:?}");
    assert_eq!(read_npy(&folder.path().join("q.npy")).len(), 6 * steps.len());
}

/// The simulated time of a step is shorter, and the motion that of such steps.
#[tokio::test(flavor = "multi_thread")]
async fn slow_motion_simulates_shorter_steps() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let record = folder.path().display().to_string();
    let server = Arc::new(tree_server());
    let url = serve(Arc::clone(&server)).await;
    let mut records = vec![];
    for options in [["--dt", "0.5", "--slow", "100"], ["--dt", "0.005", "--slow", "1"], ["--dt", "0.5", "--slow", "1"]]
    {
        let arguments = ["toy", "--steps", "5", "--record", &record, "--json"];
        let sim_output = run_sim(&url, &[&arguments[..], &options].concat()).await;
        assert_eq!(sim_output.exit_code, 0, "{}", sim_output.stderr);
        let last_time = server.steps.lock().expect("lock").last().expect("a step").time;
        records.push((sim_output.report()["dt_s"].clone(), last_time, read_npy(&folder.path().join("q.npy"))));
    }
    assert_eq!(records[0], records[1]);
    assert!(records[0].2 != records[2].2 && records[0].1 == 0.02, "{records:?}");
}

/// The slow motion follows from the lowest frequency, unless a factor is given.
#[tokio::test(flavor = "multi_thread")]
async fn slow_motion_by_the_lowest_frequency_is_announced() {
    // The lowest frequency of the tree is 0.9 Hz, and that of the fork 206 Hz.
    let mut fork_server = tree_server();
    fork_server.domains.truncate(1);
    fork_server.domains[0].shape.eigenvalues =
        [206.0, 400.0].map(|hertz: f64| (std::f64::consts::TAU * hertz).powi(2)).to_vec();
    let (fork, tree) = (serve(Arc::new(fork_server)).await, serve(Arc::new(tree_server())).await);
    let message = "toy: slow motion at 1/100 of real time, which shows the lowest frequency of 206.0000 Hz as 2.06 Hz";
    for (url, slow, factor, is_announced) in
        [(&fork, "auto", 100.0, true), (&fork, "7", 7.0, false), (&tree, "auto", 1.0, false)]
    {
        let sim_output = run_sim(url, &["toy", "--forces", "--slow", slow, "--steps", "2", "--json"]).await;
        assert_eq!(sim_output.exit_code, 0, "{}", sim_output.stderr);
        assert_eq!(sim_output.report()["slow"].as_f64(), Some(factor));
        assert_eq!(sim_output.stderr.contains(message), is_announced, "{}", sim_output.stderr);
    }
}

/// The expected codes are those of `modalcast-sim --help`: 1 rejected by the server, 2 command line, 3 connection, 4
/// local file, 5 invalid content.
#[tokio::test(flavor = "multi_thread")]
async fn errors_exit_with_documented_codes() {
    let url = serve(Arc::new(tree_server())).await;
    assert_eq!(run_sim(&url, &["--scene", "none"]).await.exit_code, 1);
    assert_eq!(run_sim(&url, &["--dt", "0"]).await.exit_code, 2);
    assert_eq!(run_sim("http://127.0.0.1:1", &["--json"]).await.exit_code, 3);
    assert_eq!(run_sim(&url, &["--scene", "toy", "--cubic", "/nowhere.cub"]).await.exit_code, 4);
}

/// The only file of cubic forces in the folder is reported but not used, because the scene does not name it.
#[tokio::test(flavor = "multi_thread")]
async fn cubic_forces_of_another_model_are_not_used() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    std::fs::write(folder.path().join("other.cub"), "2\n").expect("a writable file");
    let files = folder.path().display().to_string();
    let url = serve(Arc::new(tree_server())).await;
    let sim_output = run_sim(&url, &["--scene", "toy", "--files", &files, "--steps", "2"]).await;
    assert_eq!(sim_output.exit_code, 0, "{}", sim_output.stderr);
    assert!(sim_output.stderr.contains("modes in a wind"), "{}", sim_output.stderr);
    assert!(sim_output.stderr.contains("not used as cubic forces: ") && sim_output.stderr.contains("other.cub"));
}

/// Writes the files of a Vega model of rank 2: linear forces, and the modes of a domain.
fn write_vega_files(folder: &Path, name: &str, domain: &FakeDomain) {
    let counts = [2_i32, 2, 3, 4];
    let mut coefficients = vec![40.0_f64, 0.0, 0.0, 90.0];
    coefficients.resize(2 * (2 + 3 + 4), 0.0);
    let bytes = [pack(&counts), pack(&coefficients)].concat();
    std::fs::write(folder.join(format!("{name}.cub")), bytes).expect("a writable file");
    let rows = domain.modes.len() / 2;
    let columns: Vec<f32> = (0..2).flat_map(|column| domain.modes.iter().skip(column).step_by(2).copied()).collect();
    let bytes = [pack(&[rows as i32, 2]), pack(&columns)].concat();
    std::fs::write(folder.join(format!("{name}.URendering.float")), bytes).expect("a writable file");
}

/// Both domains have rank 2. The modes next to the forces identify the domain, and so does its name.
#[tokio::test(flavor = "multi_thread")]
async fn cubic_forces_move_the_domain_with_their_modes() {
    let domains: Vec<FakeDomain> = [("a", 0.05), ("b", 0.04)]
        .into_iter()
        .enumerate()
        .map(|(index, (name, radius))| {
            let mut domain = beam(index as u32, radius);
            domain.wire.name = name.into();
            domain.wire.notes.insert("vega.cubic".into(), format!("{name}.cub"));
            domain
        })
        .collect();
    let folder = tempfile::tempdir().expect("a temporary folder");
    write_vega_files(folder.path(), "b", &domains[1]);
    let url = serve(Arc::new(FakeServer::new(domains.clone()))).await;
    let files = folder.path().display().to_string();
    let record = folder.path().join("record").display().to_string();
    for (options, moved_domain) in
        [(&[][..], 1), (&["--domain", "b"], 1), (&["--domain", "a"], 0), (&["--domain", "0"], 0)]
    {
        let arguments = ["--scene", "toy", "--files", &files, "--steps", "3", "--record", &record];
        let sim_output = run_sim(&url, &[&arguments[..], options].concat()).await;
        assert_eq!(sim_output.exit_code, 0, "{}", sim_output.stderr);
        // Two domains with two coordinates each.
        let q = read_npy(&folder.path().join("record/q.npy"));
        let moves = |domain: usize| q.chunks(4).any(|row| row[2 * domain..][..2] != [0.0; 2]);
        assert!(moves(moved_domain) && !moves(1 - moved_domain), "{options:?}: {q:?}");
    }
    // Both domains have the modes of the file; then there is no such file; then there are two files.
    let twins = FakeServer::new((0..2).map(|index| beam(index, 0.04)).collect());
    let ambiguous_url = serve(Arc::new(twins)).await;
    let cubic = folder.path().join("b.cub").display().to_string();
    let sim_output = run_sim(&ambiguous_url, &["--scene", "toy", "--cubic", &cubic]).await;
    let names = "several: 'domain 0' (index 0), 'domain 1' (index 1)";
    assert!(sim_output.exit_code == 5 && sim_output.stderr.contains(names), "{}", sim_output.stderr);
    std::fs::remove_file(folder.path().join("b.URendering.float")).expect("an existing file");
    let sim_output = run_sim(&url, &["--scene", "toy", "--cubic", &cubic]).await;
    assert!(sim_output.exit_code == 5 && sim_output.stderr.contains("--domain NAME"), "{}", sim_output.stderr);
    write_vega_files(folder.path(), "a", &domains[0]);
    let sim_output = run_sim(&url, &["--scene", "toy", "--files", &files]).await;
    assert!(sim_output.exit_code == 5 && sim_output.stderr.contains("a.cub, "), "{}", sim_output.stderr);
}

/// The folder of a Vega model.
fn vega_folder(name: &str) -> PathBuf {
    let default_folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data");
    let data: PathBuf = std::env::var_os("MODALCAST_DATA").map_or_else(|| default_folder.into(), Into::into);
    data.join("vega").join(name)
}

/// A domain with the `v` positions of the OBJ file in file order, and U of the `.URendering.float` file. The file has U
/// in column-major order, after its numbers of rows and columns; a fake domain has U in row-major order.
fn vega_domain(name: &str) -> FakeDomain {
    let text = std::fs::read_to_string(vega_folder(name).join(format!("{name}.obj"))).expect("an OBJ file");
    let positions = text.lines().filter_map(|line| line.strip_prefix("v "));
    let rest_positions: Vec<f32> = positions
        .flat_map(|line| line.split_whitespace().take(3).map(|number| number.parse().expect("a number")))
        .collect();
    let file = std::fs::read(vega_folder(name).join(format!("{name}.URendering.float"))).expect("a file of U");
    let read_size =
        |offset: usize| i32::from_le_bytes(file[offset..offset + 4].try_into().expect("four bytes")) as usize;
    let (rows, columns, entries) = (read_size(0), read_size(4), fake::decode_f32(&file[8..]));
    assert_eq!(rows, rest_positions.len());
    let modes = (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column)));
    FakeDomain::new(
        0,
        rest_positions,
        columns as u32,
        modes.map(|(row, column)| entries[column * rows + row]).collect(),
    )
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
async fn real_models_deflect_as_requested_and_stay_bounded() {
    // The lowest frequency of the .cub file (1 Hz and 37.68 Hz) times the factor `baseFrequency` of the .config file
    // (0.25 and 0.02).
    for (name, expected_hertz) in [("simpleBridge", 0.25), ("A", 37.68 * 0.02)] {
        let mut domain = vega_domain(name);
        domain.wire.notes.insert("vega.cubic".into(), format!("{name}.cub"));
        let url = serve(Arc::new(FakeServer::new(vec![domain]))).await;
        let files = vega_folder(name).display().to_string();
        for dt in ["0.0166667", "1"] {
            let arguments = ["--scene", "toy", "--files", &files, "--steps", "60", "--dt", dt, "--json"];
            let sim_output = run_sim(&url, &arguments).await;
            assert!(sim_output.exit_code == 0 && sim_output.stderr.contains("cubic forces"), "{}", sim_output.stderr);
            let report = sim_output.report();
            let number = |field: &str| report[field].as_f64().expect("a number");
            // The default of --deflection is 0.03.
            assert!((number("deflection_of_diagonal") - 0.03).abs() <= 1e-4, "{report}");
            assert!((0.02..0.3).contains(&number("peak_of_diagonal")), "{report}");
            let lowest_hertz = report["frequencies_hz"][0].as_f64().expect("a number");
            assert!((lowest_hertz / expected_hertz - 1.0).abs() <= 1e-3, "{lowest_hertz} Hz");
            println!("{name} dt {dt}: {report}");
        }
    }
}
