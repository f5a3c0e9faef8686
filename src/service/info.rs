//! `ServerService`: version, devices and limits of the server.

use modalcast_proto::v1;
use tonic::{Request, Response, Status};

use super::connection::MAX_DRIVES;
use crate::engine::Engine;

/// Implementation of `ServerService`.
pub(super) struct ServerServiceImpl(pub(super) Engine);

#[tonic::async_trait]
impl v1::server_service_server::ServerService for ServerServiceImpl {
    async fn get_server_info(
        &self,
        _: Request<v1::GetServerInfoRequest>,
    ) -> Result<Response<v1::GetServerInfoResponse>, Status> {
        let info = self.0.info();
        let config = self.0.config();
        let (renderer, is_software) = match &info.renderer {
            Ok(renderer) => (renderer.renderer.clone(), renderer.software),
            Err(error) => (format!("none: {error}"), false),
        };
        let limits = v1::Limits {
            message_bytes: config.message_bytes as u64,
            frame_side: self.0.frame_side(),
            scenes: config.open_scenes as u32,
            window: config.max_window,
            upload_bytes: config.upload_bytes,
            deadline_ms: u32::try_from(config.deadline.as_millis()).unwrap_or(u32::MAX),
            drives: MAX_DRIVES as u32,
        };
        Ok(Response::new(v1::GetServerInfoResponse {
            version: env!("CARGO_PKG_VERSION").into(),
            backend: info.backend.name().into(),
            device: info.device.clone(),
            renderer,
            software: is_software,
            limits: Some(limits),
        }))
    }
}
