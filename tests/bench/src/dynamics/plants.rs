//! The time of a step of the physics process for plants of 100 to 10,000 domains that act on each other: the wind, the
//! equations of motion, the transforms of all domains, and the measurement of the largest motions.

use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use rustix::time::{ClockId, clock_gettime};
use serde::Serialize;

use super::plant_files::{DOMAINS_PER_SHOOT, write_plant};
use crate::timing::quantile;
use crate::workloads::Size;
use modalcast::config::{Authentication, BackendChoice, Config, ListenAddress, RendererChoice};
use modalcast::engine::Engine;
use modalcast::service;
use modalcast_client::Client;
use modalcast_dynamics::model::Model;
use modalcast_dynamics::run::Scenario as _;
use modalcast_dynamics::step_values::StepValues;
use modalcast_dynamics::tree::{TreeOptions, TreeScenario, default_wind_speed};
use modalcast_dynamics::{Result as DynamicsResult, invalid_input};
use modalcast_model::error::fault_in;
use modalcast_model::load::SceneRepository;

pub(super) const CASE: &str = "plants";

/// Numbers of domains of generated plants.
const DOMAINS: [usize; 5] = [100, 300, 1_000, 3_000, 10_000];

/// A real plant in the folder of scenes.
const ALMOND: &str = "plants/almond";

/// Surface samples per domain, as `modalcast-sim` reads them of a tree.
const SAMPLES: usize = 24;

/// Seconds per step.
const DT: f64 = 1.0 / 60.0;

/// Steps before the measurement: the strongest gust, which comes first.
const FIRST_STEPS: u64 = 120;

/// Series of steps, of which the median counts, and domains times steps of one series.
const SERIES: usize = 5;
const DOMAIN_STEPS: usize = 200_000;

/// The time of a step of one plant.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PlantRow {
    pub plant: String,
    pub domains: usize,
    pub coordinates: usize,
    /// Steps of a series.
    pub steps: u64,
    /// By the wall clock, on all cores.
    pub step_us: f64,
    /// The time of all cores together.
    pub step_cpu_us: f64,
    /// Runnable processes of the machine on average over the last minute; `None` if the system does not tell.
    pub load_average: Option<f64>,
}

impl PlantRow {
    /// The time of all cores together per domain and step, microseconds.
    pub fn domain_cpu_us(&self) -> f64 {
        self.step_cpu_us / self.domains as f64
    }
}

/// Measures generated plants and, from the folder `scenes`, the almond tree.
pub(super) fn measure(scenes: Option<&Path>, size: Size) -> DynamicsResult<Vec<PlantRow>> {
    let domains = if size == Size::Full { &DOMAINS[..] } else { &DOMAINS[..2] };
    let mut rows = vec![];
    for count in domains {
        rows.push(measure_plant(&format!("generated, {count} domains"), generated_plant(*count)?)?);
    }
    if let Some(scenes) = scenes.filter(|scenes| scenes.join(ALMOND).is_dir()) {
        rows.push(measure_plant("almond", fetch_model(scenes, ALMOND)?)?);
    }
    Ok(rows)
}

/// A plant of the given number of domains, a multiple of ten.
pub(super) fn generated_plant(domains: usize) -> DynamicsResult<Model> {
    let folder = tempfile::tempdir().map_err(|error| plant_error("a temporary folder", error))?;
    write_plant(folder.path(), domains / DOMAINS_PER_SHOOT).map_err(|error| plant_error("writable files", error))?;
    fetch_model(folder.path(), "plant.obj")
}

/// The model of a scene in a folder, by a server in this process.
fn fetch_model(folder: &Path, source: &str) -> DynamicsResult<Model> {
    let runtime = tokio::runtime::Runtime::new().map_err(|error| plant_error("a runtime", error))?;
    runtime.block_on(async {
        let state = tempfile::tempdir().map_err(|error| plant_error("a temporary folder", error))?;
        let address = serve(folder, state.path()).await.map_err(|error| plant_error("a server", error))?;
        let client = Client::connect(&address).await?;
        let scene = client.open_scene(source, "").await?.scene;
        Model::fetch(&client, &scene, SAMPLES).await
    })
}

/// Starts a server that ends with the runtime. Returns its address.
async fn serve(folder: &Path, state: &Path) -> modalcast_model::error::Result<String> {
    let config = Config {
        authentication: Authentication::Off,
        listen: vec![ListenAddress::Tcp(([127, 0, 0, 1], 0).into())],
        state: state.to_owned(),
        backend: BackendChoice::Cpu,
        renderer: RendererChoice::Off,
        viewer: false,
        ..Config::default()
    };
    let config = config.validated()?;
    let listener = service::bind(&config).await?;
    let address = listener.urls().first().cloned().ok_or("no address").map_err(fault_in("plant"))?;
    let engine = Engine::start(config, Arc::new(SceneRepository::new(Some(folder))?)).await?;
    tokio::spawn(service::serve(engine, listener, std::future::pending()));
    Ok(address)
}

fn plant_error(expected: &str, error: impl std::fmt::Display) -> modalcast_dynamics::Error {
    invalid_input("plant", expected.to_owned(), error)
}

/// Measures steps in the default wind.
pub(super) fn measure_plant(name: &str, model: Model) -> DynamicsResult<PlantRow> {
    let (domains, coordinates) = (model.domains.len(), model.coordinate_count);
    let direction_radians = 0.4;
    let wind_speed = default_wind_speed(&model, direction_radians)?;
    let options = TreeOptions { dt: DT, wind_speed, direction_radians, seed: 7 };
    let mut scenario = TreeScenario::new(model, options)?;
    let mut values = StepValues::default();
    let mut advance = |steps: u64| (0..steps).try_for_each(|_| scenario.compute_next_step(&mut values));
    advance(FIRST_STEPS)?;
    let steps = (DOMAIN_STEPS / domains).max(1) as u64;
    let (mut wall_us, mut cpu_us) = (vec![], vec![]);
    for _ in 0..if cfg!(test) { 1 } else { SERIES } {
        let (start, cpu_start) = (Instant::now(), process_cpu_us());
        advance(steps)?;
        wall_us.push(start.elapsed().as_secs_f64() * 1e6 / steps as f64);
        cpu_us.push((process_cpu_us() - cpu_start) / steps as f64);
    }
    Ok(PlantRow {
        plant: name.to_owned(),
        domains,
        coordinates,
        steps,
        step_us: quantile(&mut wall_us, 0.5).unwrap_or(f64::NAN),
        step_cpu_us: quantile(&mut cpu_us, 0.5).unwrap_or(f64::NAN),
        load_average: load_average(),
    })
}

/// The time that all threads of this process have computed, microseconds.
fn process_cpu_us() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec as f64 * 1e6 + time.tv_nsec as f64 / 1e3
}

/// The load average of the last minute according to Linux.
fn load_average() -> Option<f64> {
    std::fs::read_to_string("/proc/loadavg").ok()?.split_whitespace().next()?.parse().ok()
}
