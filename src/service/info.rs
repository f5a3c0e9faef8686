//! `ServerService`: version, features, devices and limits of the server, links to its viewer, and its clients.

use std::sync::Arc;
use std::time::Duration;

use modalcast_proto::v1;
use tonic::{Request, Response, Status};

use super::caller::Caller;
use super::clients::{ClientTable, MAX_LIST_BYTES};
use super::connection::MAX_DRIVES;
use super::status::to_status;
use super::stream::respond_once;
use crate::admission::Limit;
use crate::engine::{Engine, EngineInfo};
use crate::identity::{Credential, Principal, Role};
use modalcast_model::error::{Error, invalid};

/// Implementation of `ServerService`.
pub(super) struct ServerServiceImpl {
    pub(super) engine: Engine,
    pub(super) clients: ClientTable,
    /// See `CreateViewerLinkResponse.urls`.
    pub(super) viewer_urls: Vec<String>,
    pub(super) has_shared_memory: bool,
}

#[tonic::async_trait]
impl v1::server_service_server::ServerService for ServerServiceImpl {
    async fn get_server_info(
        &self,
        _: Request<v1::GetServerInfoRequest>,
    ) -> Result<Response<v1::GetServerInfoResponse>, Status> {
        let info = self.engine.info();
        let config = self.engine.config();
        let (renderer, is_software) = match &info.renderer {
            Ok(renderer) => (renderer.renderer.clone(), renderer.software),
            Err(error) => (format!("none: {error}"), false),
        };
        let limits = v1::Limits {
            message_bytes: config.message_bytes as u64,
            frame_side: self.engine.frame_side(),
            scenes: config.open_scenes as u32,
            window: config.max_window,
            upload_bytes: config.upload_bytes,
            deadline_ms: to_ms(config.deadline),
            client_scenes: Limit::OPEN_SCENES.of_client(config) as u32,
            client_upload_bytes: Limit::STORED_BYTES.of_client(config) as u64,
            drives: MAX_DRIVES as u32,
            connection_receive_bytes: Limit::RECEIVED_BYTES.of_client(config) as u64,
            message_timeout_ms: to_ms(config.message_timeout),
            connection_reply_bytes: config.connection_reply_bytes as u64,
            reply_timeout_ms: to_ms(config.reply_timeout),
            scene_host_bytes: info.memory.scene_host,
            scene_device_bytes: if info.memory.has_device { info.memory.scene_device } else { 0 },
            render_target_bytes: info.memory.render_targets,
            stall_budget_ms: to_ms(config.stall_budget),
        };
        Ok(Response::new(v1::GetServerInfoResponse {
            version: env!("CARGO_PKG_VERSION").into(),
            backend: info.backend.name().into(),
            device: info.device.clone(),
            renderer,
            software: is_software,
            limits: Some(limits),
            protocol_version: v1::PROTOCOL_VERSION,
            features: list_features(info, self.has_shared_memory, config.viewer).into_iter().map(Into::into).collect(),
            viewer_url_path: if config.viewer { "/".into() } else { String::new() },
        }))
    }

    async fn create_viewer_link(
        &self,
        request: Request<v1::CreateViewerLinkRequest>,
    ) -> Result<Response<v1::CreateViewerLinkResponse>, Status> {
        let Caller { principal, credential, .. } = Caller::of(&request)?;
        let v1::CreateViewerLinkRequest { principal: name } = request.into_inner();
        if !self.engine.config().viewer {
            let remedy = "Start it without --no-viewer".into();
            let reason = "the server has no viewer".into();
            return Err(to_status(Error::Unavailable { what: "viewer", reason, remedy }));
        }
        let credential = match name.is_empty() || name == principal.name {
            true => credential,
            false => self.find_principal(&name, &principal).map_err(to_status)?,
        };
        let url_path = self.clients.authenticator.viewer_url_path(&credential).map_err(to_status)?;
        let public_url = self.engine.config().public_url.as_ref().map(ToString::to_string).unwrap_or_default();
        Ok(Response::new(v1::CreateViewerLinkResponse { url_path, urls: self.viewer_urls.clone(), public_url }))
    }

    async fn list_clients(
        &self,
        request: Request<v1::ListClientsRequest>,
    ) -> Result<Response<v1::ListClientsResponse>, Status> {
        let Caller { account, replies, .. } = Caller::of(&request)?;
        let clients = self.clients.clone();
        respond_once(replies, MAX_LIST_BYTES, async move { Ok(clients.list(&account)) }).await
    }

    async fn end_client(
        &self,
        request: Request<v1::EndClientRequest>,
    ) -> Result<Response<v1::EndClientResponse>, Status> {
        let caller = Caller::of(&request)?;
        let id = request.into_inner().id;
        let ended = self.clients.end(&id, &caller.account).map_err(to_status);
        let ended = caller.log_ended_client(&id, ended)?;
        Ok(Response::new(ended))
    }
}

impl ServerServiceImpl {
    /// The credential for sessions of another principal, which only an administrator may give.
    fn find_principal(&self, name: &str, caller: &Principal) -> Result<Arc<Credential>, Error> {
        if caller.role != Role::Admin {
            let given = format!("'{}' with the role '{}'", caller.name, caller.role.name());
            let expected = "the role 'admin' for a link of another principal".into();
            return Err(Error::NotPermitted { expected, given });
        }
        let unknown = || invalid("principal", "a principal of this server", format!("'{}'", name.escape_debug()));
        self.clients.authenticator.directory().find_name(name).ok_or_else(unknown)
    }
}

fn to_ms(duration: Duration) -> u32 {
    u32::try_from(duration.as_millis()).unwrap_or(u32::MAX)
}

/// The features of a server with these devices and settings.
fn list_features(info: &EngineInfo, has_shared_memory: bool, has_viewer: bool) -> Vec<v1::Feature> {
    let mut features =
        vec![v1::Feature::ContentHashes, v1::Feature::UploadReuse, v1::Feature::UploadArrays, v1::Feature::PackedQ];
    if info.renderer.is_ok() {
        features.extend([v1::Feature::Frames, v1::Feature::RgbFrames]);
    }
    features.extend(has_shared_memory.then_some(v1::Feature::SharedMemory));
    features.extend(has_viewer.then_some(v1::Feature::Viewer));
    features
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::MemoryLimits;
    use modalcast_model::deform::Backend;
    use modalcast_model::error::fault;
    use modalcast_render::RendererInfo;

    #[test]
    fn frames_shared_memory_and_viewer_are_optional() {
        let renderer = RendererInfo {
            renderer: "test".into(),
            version: "4.6".into(),
            software: true,
            cuda_device: None,
            max_side: 1,
            pixel_readback: modalcast_render::PixelReadback::CopyEngine,
        };
        let memory =
            MemoryLimits { host: 4, scene_host: 2, device: 0, scene_device: 0, render_targets: 1, has_device: false };
        let info = |renderer| EngineInfo { backend: Backend::Cpu, device: "none".into(), renderer, memory };
        let always =
            [v1::Feature::ContentHashes, v1::Feature::UploadReuse, v1::Feature::UploadArrays, v1::Feature::PackedQ];
        let no_renderer = info(Err(fault("renderer", "none")));
        assert_eq!(list_features(&no_renderer, false, false), always);
        let features = list_features(&info(Ok(renderer)), true, true);
        let expected = [v1::Feature::Frames, v1::Feature::RgbFrames, v1::Feature::SharedMemory, v1::Feature::Viewer];
        assert_eq!(features[always.len()..], expected);
    }
}
