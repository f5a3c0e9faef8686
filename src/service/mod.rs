//! The gRPC services: translate between wire messages and the engine's values. The only module that uses the protobuf
//! types; one file per group of calls.

mod convert;
mod describe;
mod frames;
mod info;
mod listen;
mod picks;
mod routes;
mod scenes;
mod status;
mod steps;
mod stream;
mod vertices;

use modalcast_proto::v1;
use tokio::net::TcpListener;
use tokio::sync::oneshot;
use tokio::time::Instant;
use tonic::transport::Server;
use tonic_health::server::HealthReporter;

use self::routes::Routes;
use crate::config::Config;
use crate::engine::Engine;
use modalcast_model::error::{Error, Result, fault_in};

/// The largest message that the server sends, in bytes: a chunk of at most 1 MiB and its head. The head of a vertex
/// reply lists up to 65 536 domains with their counts.
const MAX_REPLY_BYTES: usize = 3 << 20;

/// Binds the configured address.
///
/// # Errors
/// `Unavailable` when the address is in use or does not belong to this machine.
pub async fn bind(config: &Config) -> Result<TcpListener> {
    TcpListener::bind(config.listen).await.map_err(|error| Error::Unavailable {
        what: "listening address",
        reason: format!("{}: {error}", config.listen),
        remedy: "Name another one with --listen".into(),
    })
}

/// Serves until `shutdown` completes. Then reports "not serving" to health checks, ends every stream and returns within
/// the configured drain time, whether or not clients close their connections. A lost device does not end the server,
/// but health checks get "not serving" from then on, so that a supervisor can restart it.
///
/// # Errors
/// `Fault` when the transport fails.
pub async fn serve(
    engine: Engine,
    listener: TcpListener,
    shutdown: impl Future<Output = ()> + Send + 'static,
) -> Result<()> {
    let config = engine.config().clone();
    let (health, health_server) = tonic_health::server::health_reporter();
    set_health(&health, true).await;
    let routes = routes(&engine, &config)?.with(health_server);
    let connections = listen::connections(listener, config.connections, config.first_byte_timeout);
    let (stop, stopped) = oneshot::channel();
    let drain = async move {
        let mut shutdown = std::pin::pin!(shutdown);
        tokio::select! {
            () = &mut shutdown => {}
            _ = engine.device_lost() => {
                set_health(&health, false).await;
                shutdown.await;
            }
        }
        tracing::info!("the server stops");
        let end = Instant::now() + engine.config().drain_timeout;
        set_health(&health, false).await;
        if tokio::time::timeout_at(end, engine.shutdown()).await.is_err() {
            tracing::warn!("the device did not stop in time");
        }
        stop.send(()).ok(); // Fails only if the transport has failed and dropped the receiver.
        end
    };
    let shutdown_signal = async {
        stopped.await.ok(); // A dropped sender means stop, too.
    };
    let mut transport =
        std::pin::pin!(transport(&config).serve_with_incoming_shutdown(routes, connections, shutdown_signal));
    let end = tokio::select! {
        ended = &mut transport => return ended.map_err(fault_in("transport")),
        end = drain => end,
    };
    match tokio::time::timeout_at(end, transport).await {
        Ok(ended) => ended.map_err(fault_in("transport")),
        Err(_) => {
            tracing::warn!("some clients did not close their connections and are left behind");
            Ok(())
        }
    }
}

async fn set_health(health: &HealthReporter, serving: bool) {
    use tonic_health::ServingStatus::{NotServing, Serving};
    let status = if serving { Serving } else { NotServing };
    let services = ["SceneService", "StepService", "FrameService", "VertexService", "ServerService"];
    for name in services.map(|service| format!("modalcast.v1.{service}")).into_iter().chain([String::new()]) {
        health.set_service_status(name, status).await;
    }
}

/// The transport with every limit set explicitly, because the library's defaults disable some of them.
fn transport(config: &Config) -> Server {
    Server::builder()
        .max_concurrent_streams(128)
        .concurrency_limit_per_connection(64)
        .http2_max_local_error_reset_streams(Some(1024))
        .http2_max_pending_accept_reset_streams(Some(100))
        .http2_max_header_list_size(16 << 10)
        .initial_stream_window_size(64 << 10)
        .initial_connection_window_size(16 << 20)
        .max_frame_size(64 << 10)
        .http2_keepalive_interval(Some(config.keepalive_interval))
        .http2_keepalive_timeout(Some(config.keepalive_timeout))
}

fn routes(engine: &Engine, config: &Config) -> Result<Routes> {
    use v1::frame_service_server::FrameServiceServer;
    use v1::scene_service_server::SceneServiceServer;
    use v1::server_service_server::ServerServiceServer;
    use v1::step_service_server::StepServiceServer;
    use v1::vertex_service_server::VertexServiceServer;
    // A macro, because the generated servers share no trait for these methods.
    macro_rules! limited {
        ($server:expr) => {
            $server.max_decoding_message_size(config.message_bytes).max_encoding_message_size(MAX_REPLY_BYTES)
        };
    }
    let reflection = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(v1::DESCRIPTORS)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };
    Ok(Routes::default()
        .with(reflection().build_v1().map_err(fault_in("reflection"))?)
        .with(reflection().build_v1alpha().map_err(fault_in("reflection"))?)
        .with(limited!(ServerServiceServer::new(info::ServerServiceImpl(engine.clone()))))
        .with(limited!(SceneServiceServer::new(scenes::SceneServiceImpl(engine.clone()))))
        .with(limited!(StepServiceServer::new(steps::StepServiceImpl(engine.clone()))))
        .with(limited!(FrameServiceServer::new(frames::FrameServiceImpl(engine.clone()))))
        .with(limited!(VertexServiceServer::new(vertices::VertexServiceImpl(engine.clone())))))
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use tonic::transport::Channel;
    use tonic_health::ServingStatus;
    use tonic_health::pb::HealthCheckRequest;
    use tonic_health::pb::health_client::HealthClient;

    use super::*;
    use crate::engine::Policy;

    async fn health(client: &mut HealthClient<Channel>) -> i32 {
        let request = HealthCheckRequest { service: String::new() };
        client.check(request).await.expect("an answer").into_inner().status
    }

    #[tokio::test]
    async fn lost_device_turns_health_to_not_serving() {
        let folder = tempfile::tempdir().expect("a folder");
        let config =
            Config { listen: ([127, 0, 0, 1], 0).into(), state: folder.path().to_owned(), ..Config::default() };
        let config = config.validated().expect("a good configuration");
        let listener = bind(&config).await.expect("a port");
        let address = format!("http://{}", listener.local_addr().expect("an address"));
        let (engine, step) = Engine::with_losable_device(config).await.expect("starts");
        let (stop, stopped) = oneshot::channel::<()>();
        let server = tokio::spawn(serve(engine.clone(), listener, async {
            stopped.await.ok();
        }));
        let mut client =
            HealthClient::new(Channel::from_shared(address).expect("a URL").connect().await.expect("connects"));
        assert_eq!(health(&mut client).await, ServingStatus::Serving as i32);
        let scene = engine.find("strips").expect("is open");
        let mut writer = scene.drive("test".into(), Policy::Lossless, 4).await.expect("a lease");
        writer.step(&step).expect("is queued");
        let turned = async {
            while health(&mut client).await != ServingStatus::NotServing as i32 {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        };
        tokio::time::timeout(Duration::from_secs(60), turned).await.expect("health turns");
        stop.send(()).expect("the server goes on until it is stopped");
        server.await.expect("no panic").expect("a clean stop");
    }
}
