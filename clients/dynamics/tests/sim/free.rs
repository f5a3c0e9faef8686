//! Free bodies of `modalcast-sim --free`.

use std::sync::Arc;

use modalcast_client::v1;

use super::fake::{self, FakeServer, serve};
use super::{read_npy, run_sim, tree_server};

/// A server with one beam of 3 kg that a viewer pulls along z at its tip.
fn beam_server(mass: f64) -> FakeServer {
    let mut domain = tree_server().domains.swap_remove(0);
    domain.wire.inertia = Some(v1::Inertia {
        mass,
        center: vec![0.0, 0.5, 0.0],
        moments: vec![mass / 3.0, 0.01 * mass, mass / 3.0, 0.0, 0.0, 0.0],
        // Of the free beam: its modes have no momentum.
        modal_momenta: vec![0.0; 12],
        modal_masses: vec![1.0, 0.0, 0.0, 1.0],
    });
    let mut server = FakeServer::new(vec![domain]);
    let surface = v1::SurfaceForce { triangle: 0, barycentric: vec![1.0, 0.0, 0.0], vector: vec![0.0, 0.0, 0.6] };
    let force = v1::Force { id: 1, domain: 0, kind: Some(v1::force::Kind::Surface(surface)) };
    let rest_point = vec![0.0, 1.0, 0.0];
    server.forces =
        vec![v1::AppliedForce { owner: 1, force: Some(force), f_q: fake::pack(&[0.0_f32, 0.6]).into(), rest_point }];
    server
}

#[tokio::test(flavor = "multi_thread")]
async fn pull_moves_and_turns_a_free_body() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let record = folder.path().display().to_string();
    let arguments = ["toy", "--forces", "--steps", "61", "--record", &record, "--json"];
    let mut last = vec![];
    for options in [&["--free"][..], &[]] {
        let url = serve(Arc::new(beam_server(3.0))).await;
        let sim_output = run_sim(&url, &[&arguments[..], options].concat()).await;
        assert_eq!(sim_output.exit_code, 0, "{}", sim_output.stderr);
        let transforms = read_npy(&folder.path().join("transforms.npy"));
        last.push((transforms[12 * 60..].to_vec(), sim_output.report()));
    }
    let (free, report) = &last[0];
    assert_ne!(free[..], last[1].0[..], "control: expected that a held body does not move");
    // 0.6 N on 3 kg for a second, as 60 steps.
    let displacement = report["bodies"][0]["displacement"][2].as_f64().expect("a number");
    assert!((displacement - 0.5 * 0.2 * (61.0_f64 / 60.0).powi(2)).abs() <= 1e-3, "{report}");
    // The tip turns about x, and the frame of the base moves back.
    assert!(free[9] > 0.01 && (free[0] - 1.0).abs() < 1e-6, "{free:?}");
    assert_eq!((report["free_bodies"].as_u64(), report["bodies_returned"].as_u64()), (Some(1), Some(0)));
}

#[tokio::test(flavor = "multi_thread")]
async fn free_bodies_need_mass_and_leave_with_a_remark() {
    let mut massless = beam_server(3.0);
    massless.domains[0].wire.inertia = None;
    let sim_output = run_sim(&serve(Arc::new(massless)).await, &["toy", "--free", "--steps", "3"]).await;
    let message = "inertia of 'domain 0' with all that it carries, which is free: expected a positive mass";
    assert!(sim_output.exit_code == 5 && sim_output.stderr.contains(message), "{}", sim_output.stderr);
    // Without forces, nothing moves; a steady pull returns to rest after a while.
    for (options, returns) in [(&[][..], false), (&["--forces"], true)] {
        let url = serve(Arc::new(beam_server(1e-3))).await;
        let arguments = [&["toy", "--free", "--steps", "200", "--json"][..], options].concat();
        let sim_output = run_sim(&url, &arguments).await;
        assert_eq!(sim_output.exit_code, 0, "{}", sim_output.stderr);
        assert_eq!(sim_output.stderr.contains("returns to rest"), returns, "{}", sim_output.stderr);
        assert_eq!(sim_output.report()["bodies_returned"].as_u64() > Some(0), returns);
    }
    let url = serve(Arc::new(beam_server(3.0))).await;
    assert_eq!(run_sim(&url, &["toy", "--free", "--cubic", "a.cub"]).await.exit_code, 2);
}
