//! `SceneService`: opens, uploads, lists, deletes and describes scenes, and reads rows of U.

use std::sync::Arc;

use modalcast_proto::v1;
use tonic::{Request, Response, Status, Streaming};

use super::caller::Caller;
use super::convert::{ByteBudget, parse_hashes, wire_failed_scene, wire_scene_info, wire_scene_summary};
use super::describe;
use super::status::to_status;
use super::stream::{ReplyStream, catch_panic, respond_once};
use super::uploads::receive_upload;
use crate::engine::{ArrayUpload, Engine, SceneAccess, SceneList, SceneRight, Upload};

/// Limit in bytes on the source names in one list.
const MAX_SOURCE_BYTES: usize = 512 << 10;

/// Upper bound on the size of a scene's description in bytes: remarks of about 64 KiB, names and paths. It is also above
/// that of the answers to 4096 hashes.
const MAX_INFO_BYTES: usize = 128 << 10;

/// Upper bound on the size of one list in bytes: sources, and scenes with their names and errors.
const MAX_LIST_BYTES: usize = 1 << 20;

/// Implementation of `SceneService`.
pub(super) struct SceneServiceImpl(pub(super) Engine);

#[tonic::async_trait]
impl v1::scene_service_server::SceneService for SceneServiceImpl {
    async fn open_scene(
        &self,
        request: Request<v1::OpenSceneRequest>,
    ) -> Result<Response<v1::OpenSceneResponse>, Status> {
        let caller = Caller::of(&request)?;
        let v1::OpenSceneRequest { source, scene } = request.into_inner();
        let (engine, principal, name) = (self.0.clone(), Arc::clone(&caller.principal), scene.clone());
        let client = caller.account.client;
        let opened = catch_panic(async move { engine.open(&source, &name, &principal, client).await }).await;
        let name = opened.as_ref().map_or(scene, |scene_handle| scene_handle.name.clone());
        let scene_handle = caller.log_change("OpenScene", &name, opened)?;
        respond_once(caller.replies, MAX_INFO_BYTES, async move {
            Ok(v1::OpenSceneResponse { scene: Some(wire_scene_info(&scene_handle)) })
        })
        .await
    }

    async fn upload_scene(
        &self,
        request: Request<Streaming<v1::UploadSceneRequest>>,
    ) -> Result<Response<v1::UploadSceneResponse>, Status> {
        let caller = Caller::of(&request)?;
        let upload: Upload = receive_upload(&self.0, &caller, request).await?;
        let name = upload.scene().to_owned();
        let (engine, principal) = (self.0.clone(), Arc::clone(&caller.principal));
        let opened = catch_panic(async move { engine.finish_upload(upload, &principal).await }).await;
        let scene_handle = caller.log_change("UploadScene", &name, opened)?;
        respond_once(caller.replies, MAX_INFO_BYTES, async move {
            Ok(v1::UploadSceneResponse { scene: Some(wire_scene_info(&scene_handle)) })
        })
        .await
    }

    async fn upload_arrays(
        &self,
        request: Request<Streaming<v1::UploadArraysRequest>>,
    ) -> Result<Response<v1::UploadArraysResponse>, Status> {
        let caller = Caller::of(&request)?;
        let upload: ArrayUpload = receive_upload(&self.0, &caller, request).await?;
        let name = upload.scene().to_owned();
        let (engine, principal) = (self.0.clone(), Arc::clone(&caller.principal));
        let opened = catch_panic(async move { engine.finish_array_upload(upload, &principal).await }).await;
        let scene_handle = caller.log_change("UploadArrays", &name, opened)?;
        respond_once(caller.replies, MAX_INFO_BYTES, async move {
            Ok(v1::UploadArraysResponse { scene: Some(wire_scene_info(&scene_handle)) })
        })
        .await
    }

    async fn find_uploaded_files(
        &self,
        request: Request<v1::FindUploadedFilesRequest>,
    ) -> Result<Response<v1::FindUploadedFilesResponse>, Status> {
        let (engine, Caller { principal, replies, .. }) = (self.0.clone(), Caller::of(&request)?);
        let sha256 = request.into_inner().sha256;
        let find = async move { engine.find_uploaded_files(parse_hashes(&sha256)?, &principal).await };
        let found = catch_panic(find).await?;
        respond_once(replies, MAX_INFO_BYTES, async move { Ok(v1::FindUploadedFilesResponse { found }) }).await
    }

    async fn list_scenes(
        &self,
        request: Request<v1::ListScenesRequest>,
    ) -> Result<Response<v1::ListScenesResponse>, Status> {
        let (engine, Caller { principal, replies, .. }) = (self.0.clone(), Caller::of(&request)?);
        respond_once(replies, MAX_LIST_BYTES, async move {
            let SceneList { open, opening, failed } = engine.list(&principal);
            let scenes = open.iter().map(|scene_handle| wire_scene_summary(scene_handle)).collect();
            let mut budget = ByteBudget::new(MAX_SOURCE_BYTES);
            let sources = engine.sources().await?.into_iter().take_while(|source| budget.take_string(source)).collect();
            let failed = failed.into_iter().map(wire_failed_scene).collect();
            Ok(v1::ListScenesResponse { scenes, sources, opening, failed })
        })
        .await
    }

    async fn delete_scene(
        &self,
        request: Request<v1::DeleteSceneRequest>,
    ) -> Result<Response<v1::DeleteSceneResponse>, Status> {
        let caller = Caller::of(&request)?;
        let scene = request.into_inner().scene;
        let (engine, principal, name) = (self.0.clone(), Arc::clone(&caller.principal), scene.clone());
        let closed = catch_panic(async move { engine.close(&name, &principal).await }).await;
        caller.log_change("DeleteScene", &scene, closed)?;
        respond_once(caller.replies, 0, async { Ok(v1::DeleteSceneResponse {}) }).await
    }

    async fn share_scene(
        &self,
        request: Request<v1::ShareSceneRequest>,
    ) -> Result<Response<v1::ShareSceneResponse>, Status> {
        let caller = Caller::of(&request)?;
        let v1::ShareSceneRequest { scene, principals } = request.into_inner();
        let (engine, principal, name) = (self.0.clone(), Arc::clone(&caller.principal), scene.clone());
        let shared = catch_panic(async move { engine.share(&name, &principal, principals).await }).await;
        let SceneAccess { owner, shared_with } = caller.log_change("ShareScene", &scene, shared)?;
        let shared_with = shared_with.into_iter().collect();
        respond_once(caller.replies, MAX_INFO_BYTES, async { Ok(v1::ShareSceneResponse { owner, shared_with }) }).await
    }

    type DescribeSceneStream = ReplyStream<v1::DescribeSceneResponse>;

    async fn describe_scene(
        &self,
        request: Request<v1::DescribeSceneRequest>,
    ) -> Result<Response<Self::DescribeSceneStream>, Status> {
        let Caller { principal, replies, .. } = Caller::of(&request)?;
        let request = request.into_inner();
        let scene_handle = self.0.find_opened(&request.scene, &principal, SceneRight::Use).await.map_err(to_status)?;
        describe::respond_with_description(replies, scene_handle, request, self.0.config().chunk_bytes)
            .map_err(to_status)
    }

    type ReadContentStream = ReplyStream<v1::ReadContentResponse>;

    async fn read_content(
        &self,
        request: Request<v1::ReadContentRequest>,
    ) -> Result<Response<Self::ReadContentStream>, Status> {
        let Caller { principal, replies, .. } = Caller::of(&request)?;
        let request = request.into_inner();
        let scene_handle = self.0.find_opened(&request.scene, &principal, SceneRight::Use).await.map_err(to_status)?;
        describe::respond_with_content(replies, scene_handle, request, self.0.config().chunk_bytes)
            .await
            .map_err(to_status)
    }

    type ReadModesStream = ReplyStream<v1::ReadModesResponse>;

    async fn read_modes(
        &self,
        request: Request<v1::ReadModesRequest>,
    ) -> Result<Response<Self::ReadModesStream>, Status> {
        let Caller { principal, replies, .. } = Caller::of(&request)?;
        let request = request.into_inner();
        let scene_handle = self.0.find_opened(&request.scene, &principal, SceneRight::Use).await.map_err(to_status)?;
        describe::respond_with_modes(replies, scene_handle, request, self.0.config().chunk_bytes).map_err(to_status)
    }
}
