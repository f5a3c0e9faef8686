//! The gRPC services, which translate between wire messages and engine types. This is the only module that uses the
//! protobuf types.

mod accept;
mod admin;
mod authentication;
mod caller;
mod clients;
mod connected_peers;
mod connection;
mod connection_gauges;
mod connection_table;
mod control_frames;
mod convert;
mod describe;
mod forces;
mod frame_allowance;
mod frames;
mod info;
mod interruptible_body;
mod listen;
mod metered_socket;
mod open_calls;
mod peer;
mod permissions;
mod picks;
mod progress_timer;
mod receive_budget;
mod reply_body;
mod reply_budget;
mod request_body;
mod routes;
mod scenes;
mod sent_steps;
mod shared_memory;
mod states;
mod status;
mod step_parts;
mod steps;
mod stream;
mod tls;
mod uploads;
mod vertices;
mod views;
mod web;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use modalcast_proto::v1;
use tokio::task::JoinSet;
use tokio::time::Instant;
use tonic_health::server::HealthReporter;

pub use self::listen::{Listener, host_name};

use self::accept::ConnectionServer;
use self::admin::AdminServer;
use self::clients::ClientTable;
use self::connection_gauges::ConnectionGauges;
use self::connection_table::ConnectionTable;
use self::routes::Routes;
use self::shared_memory::SharedMemory;
use self::tls::TlsServer;
use self::web::{Access, WebServer};
use crate::admission::Limit;
use crate::config::Config;
use crate::engine::Engine;
use modalcast_model::error::{Error, Result, fault_in};

/// Largest message that the server sends, in bytes: a chunk of at most 1 MiB and its head, or the layout of 65,536
/// domains.
const MAX_REPLY_BYTES: usize = 3 << 20;

/// Binds the configured addresses.
///
/// # Errors
/// `Unavailable` when an address is in use or does not belong to this machine.
pub async fn bind(config: &Config) -> Result<Listener> {
    Listener::bind(config).await
}

/// Serves until `shutdown` completes. Then answers health checks with `NOT_SERVING`, ends every stream and returns
/// within the configured drain time, whether or not clients close their connections. A lost device ends the server,
/// too. Health checks are also answered with `NOT_SERVING` while a lost renderer is opened again.
///
/// # Errors
/// `Fault` when the description of the services for reflection is invalid; `DeviceLost`.
pub async fn serve(
    engine: Engine,
    listener: Listener,
    shutdown: impl Future<Output = ()> + Send + 'static,
) -> Result<()> {
    let config = engine.config().clone();
    let (health_reporter, health_server) = tonic_health::server::health_reporter();
    let health = Health { reporter: health_reporter, is_serving: Arc::default() };
    health.set(true).await;
    let shared_memory = SharedMemory::default();
    let authenticator = Arc::clone(&listener.authenticator);
    let viewer_urls = [listener.viewer_urls(), listener.remote_viewer_urls()].concat();
    let table = ConnectionTable::new(config.connections, engine.admission());
    let peers = Arc::clone(table.peers());
    let clients = ClientTable { engine: engine.clone(), authenticator: Arc::clone(&authenticator), peers };
    let has_shared_memory = !listener.shared_memory.is_empty();
    let info = info::ServerServiceImpl { engine: engine.clone(), clients, viewer_urls, has_shared_memory };
    let routes = routes(&engine, &config, &shared_memory, info)?.with(health_server);
    let accepts_machines = listener.remote_addresses().next().is_some();
    let web = config.viewer.then(|| {
        let host_name = host_name().filter(|_| accepts_machines);
        let access = Access::new(host_name, listener.public_url.clone());
        WebServer::new(routes.clone(), access, &authenticator, Arc::clone(&health.is_serving), &config)
    });
    let web = web.transpose()?;
    // The files are removed when this function returns.
    let Listener { sockets, shared_memory: memory_sockets, files: _files, tls, admin, .. } = listener;
    let connections = ConnectionGauges::default();
    // Its tasks end when this function returns.
    let mut admin_tasks = JoinSet::new();
    if let Some(sockets) = admin {
        let (is_serving, failures) = (Arc::clone(&health.is_serving), authenticator.failures().clone());
        let admin_server = AdminServer::new(engine.clone(), is_serving, &connections, failures);
        admin_tasks.spawn(admin_server.accept_connections(sockets));
    }
    let metrics = engine.admission();
    let connection_server =
        ConnectionServer::new(routes, web, Arc::clone(&authenticator), tls.clone(), connections, &config, metrics);
    let memory_limit = Limit::SHARED_MEMORY;
    let memory_permits = metrics.pool(memory_limit, (memory_limit.total)(&config));
    let serve_memory = |socket| shared_memory.serve(socket, memory_permits.clone());
    let _shared_memory_servers: Vec<_> = memory_sockets.into_iter().map(serve_memory).collect();
    let accept_connections = connection_server.accept_connections(sockets, Arc::clone(&table));
    let report_state = report_state(engine.clone(), health.reporter.clone());
    let stop_engine = async move {
        let loss = tokio::select! {
            () = shutdown => None,
            error = report_device(&engine, &health) => Some(error),
        };
        tracing::info!("the server is shutting down");
        let drain_deadline = Instant::now() + engine.config().drain_timeout;
        health.set(false).await;
        if tokio::time::timeout_at(drain_deadline, engine.shutdown()).await.is_err() {
            tracing::warn!("the engine did not stop within the drain time");
        }
        (drain_deadline, loss)
    };
    // The sockets are closed when the engine has stopped.
    let (drain_deadline, loss) = tokio::select! {
        () = accept_connections => return Ok(()),
        () = report_state => return Ok(()),
        () = authenticator.directory().keep_fresh() => return Ok(()),
        () = keep_certificate_fresh(tls.as_deref()) => return Ok(()),
        stopped = stop_engine => stopped,
    };
    if tokio::time::timeout_at(drain_deadline, table.retire_all()).await.is_err() {
        tracing::warn!("some clients did not close their connections within the drain time");
    }
    loss.map_or(Ok(()), Err)
}

/// Keeps the certificate up to date. Waits forever without one.
async fn keep_certificate_fresh(tls: Option<&TlsServer>) {
    match tls {
        Some(tls) => tls.keep_fresh().await,
        None => std::future::pending().await,
    }
}

/// Time between the loss of the device and the end of the server, in which health checks report the loss.
const LOSS_NOTICE: Duration = Duration::from_secs(1);

/// Reports the health of the device. Returns when the device is lost, after [`LOSS_NOTICE`].
async fn report_device(engine: &Engine, health: &Health) -> Error {
    let mut device = engine.observe_device();
    loop {
        tokio::select! {
            error = engine.device_lost() => {
                health.set(false).await;
                tokio::time::sleep(LOSS_NOTICE).await;
                return error;
            }
            () = device.changed() => health.set(device.is_working()).await,
        }
    }
}

/// Service of health checks: `SERVING` while the last steps can be written to disk.
const STORAGE_HEALTH: &str = "modalcast.v1.Storage";

/// Service of health checks: `SERVING` when every scene of the last run is open or has failed.
const SCENES_HEALTH: &str = "modalcast.v1.Scenes";

/// Reports the state of the disk and of the scenes of the last run. Ends only with the engine.
async fn report_state(engine: Engine, health: HealthReporter) {
    use tonic_health::ServingStatus::{NotServing, Serving};
    let (mut is_degraded, mut are_reopened) = (engine.watch_storage(), engine.watch_reopening());
    loop {
        let states =
            [(STORAGE_HEALTH, !*is_degraded.borrow_and_update()), (SCENES_HEALTH, *are_reopened.borrow_and_update())];
        for (service, is_serving) in states {
            health.set_service_status(service, if is_serving { Serving } else { NotServing }).await;
        }
        let changed = tokio::select! {
            changed = is_degraded.changed() => changed,
            changed = are_reopened.changed() => changed,
        };
        if changed.is_err() {
            return;
        }
    }
}

/// The health of the server, for clients of gRPC and of HTTP/1.1.
struct Health {
    reporter: HealthReporter,
    is_serving: Arc<AtomicBool>,
}

impl Health {
    async fn set(&self, is_serving: bool) {
        use tonic_health::ServingStatus::{NotServing, Serving};
        self.is_serving.store(is_serving, Ordering::Relaxed);
        let status = if is_serving { Serving } else { NotServing };
        let services = [
            "SceneService",
            "StepService",
            "FrameService",
            "VertexService",
            "StateService",
            "ViewService",
            "ForceService",
            "ServerService",
        ];
        // The empty name stands for the whole server.
        for name in services.map(|service| format!("modalcast.v1.{service}")).into_iter().chain([String::new()]) {
            self.reporter.set_service_status(name, status).await;
        }
    }
}

fn routes(
    engine: &Engine,
    config: &Config,
    shared_memory: &SharedMemory,
    info: info::ServerServiceImpl,
) -> Result<Routes> {
    use v1::force_service_server::ForceServiceServer;
    use v1::frame_service_server::FrameServiceServer;
    use v1::scene_service_server::SceneServiceServer;
    use v1::server_service_server::ServerServiceServer;
    use v1::state_service_server::StateServiceServer;
    use v1::step_service_server::StepServiceServer;
    use v1::vertex_service_server::VertexServiceServer;
    use v1::view_service_server::ViewServiceServer;
    // A macro, because the generated servers share no trait for these methods.
    macro_rules! with_limits {
        ($server:expr) => {
            $server.max_decoding_message_size(config.message_bytes).max_encoding_message_size(MAX_REPLY_BYTES)
        };
    }
    let reflection = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(v1::DESCRIPTORS)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };
    let frame_service = frames::FrameServiceImpl { engine: engine.clone(), shared_memory: shared_memory.clone() };
    let vertex_service = vertices::VertexServiceImpl { engine: engine.clone(), shared_memory: shared_memory.clone() };
    let view_service = views::ViewServiceImpl { engine: engine.clone(), shared_memory: shared_memory.clone() };
    let step_service = steps::StepServiceImpl { engine: engine.clone(), shared_memory: shared_memory.clone() };
    Ok(Routes::new(Arc::clone(&info.clients.authenticator), config.message_bytes)
        .with(reflection().build_v1().map_err(fault_in("reflection"))?)
        .with(reflection().build_v1alpha().map_err(fault_in("reflection"))?)
        .with(with_limits!(ServerServiceServer::new(info)))
        .with(with_limits!(SceneServiceServer::new(scenes::SceneServiceImpl(engine.clone()))))
        .with(with_limits!(StepServiceServer::new(step_service)))
        .with(with_limits!(FrameServiceServer::new(frame_service)))
        .with(with_limits!(VertexServiceServer::new(vertex_service)))
        .with(with_limits!(ViewServiceServer::new(view_service)))
        .with(with_limits!(StateServiceServer::new(states::StateServiceImpl(engine.clone()))))
        .with(with_limits!(ForceServiceServer::new(forces::ForceServiceImpl(engine.clone())))))
}

#[cfg(test)]
mod tests {
    use tokio::sync::oneshot;
    use tonic::transport::Channel;
    use tonic_health::ServingStatus;
    use tonic_health::pb::health_client::HealthClient;
    use tonic_health::pb::{HealthCheckRequest, HealthCheckResponse};

    use super::*;
    use crate::engine::lossless_lease;
    use crate::hang_guard::HANG_GUARD;

    /// The next status of the whole server in a watch of its health.
    async fn next_status(watch: &mut tonic::Streaming<HealthCheckResponse>) -> i32 {
        let message = tokio::time::timeout(HANG_GUARD, watch.message()).await.expect("expected a status");
        message.expect("expected no error").expect("expected a status").status
    }

    #[tokio::test]
    async fn lost_device_turns_health_to_not_serving_and_ends_the_server() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let listen = crate::config::ListenAddress::Tcp(([127, 0, 0, 1], 0).into());
        let authentication = crate::config::Authentication::Off;
        let state = folder.path().to_owned();
        let config = Config { listen: vec![listen], authentication, state, ..Config::default() };
        let config = config.validated().expect("expected a valid configuration");
        let listener = bind(&config).await.expect("expected a free port");
        let address = listener.urls()[0].clone();
        let (engine, step) = Engine::with_losable_device(config).await.expect("expected a running engine");
        let (_stop_sender, stop_receiver) = oneshot::channel::<()>();
        let server = tokio::spawn(serve(engine.clone(), listener, async {
            stop_receiver.await.ok();
        }));
        let endpoint = Channel::from_shared(address).expect("expected a valid URL");
        let mut client = HealthClient::new(endpoint.connect().await.expect("expected a connection"));
        let request = HealthCheckRequest { service: String::new() };
        let mut watch = client.watch(request).await.expect("expected a watch").into_inner();
        assert_eq!(next_status(&mut watch).await, ServingStatus::Serving as i32);
        let scene_handle = engine.find("strips").expect("expected an open scene");
        let mut writer = scene_handle.drive("test", lossless_lease(4)).await.expect("expected the writer lease");
        writer.push_step(step).await.expect("expected an accepted step");
        assert_eq!(next_status(&mut watch).await, ServingStatus::NotServing as i32);
        let error = server.await.expect("expected no panic").expect_err("expected the end of the server");
        assert!(matches!(error, Error::DeviceLost { .. }), "{error}");
    }
}
