#![doc = include_str!("../README.md")]
#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout))]

mod array_upload;
mod assemble;
mod client;
mod content;
mod describe;
mod description;
mod error;
mod forces;
mod frames;
mod message_stream;
mod messages;
pub mod npy;
mod pick;
pub mod program;
mod request;
mod scene;
mod server_address;
mod server_channel;
mod shared_memory;
mod stages;
mod state_packing;
mod states;
mod step;
mod step_stream;
mod upload;
mod vertex_encoding;
mod vertex_sections;
mod vertices;

pub use array_upload::{ArrayUpload, UploadDomain, UploadShape};
pub use assemble::Replies;
pub use client::{Client, REPLY_LIMIT, SceneList, ServerInfo};
pub use content::ContentHash;
pub use describe::{DescriptionRequest, ModeRows};
pub use error::{Error, Reason, Rejection, Result};
pub use forces::{AppliedForce, Force, ForceKind, ForceRequest, ForceSet, ForceStream, SurfaceForce};
pub use frames::{
    Camera, DrawnBy, Frame, FrameFormat, FrameLook, FrameRequest, FrameStream, FrameStreamRequest, FramesRequest, Lens,
    Output, Picture, Pictures, View,
};
pub use modalcast_proto::v1;
pub use modalcast_proto::v1::{Feature, PROTOCOL_VERSION, SceneInfo, StepId};
pub use pick::{Hit, PickRectangle, PickRequest, PickResult};
pub use request::{Delivery, StepRequest, StepSelector, Subscription};
pub use scene::{
    AlphaMode, Attachment, Domain, Follow, Inertia, Material, MaterialRange, SceneDescription, Shape, ShapeArray,
    Texture,
};
pub use server_address::{ConnectOptions, TOKEN_FILE_VARIABLE};
pub use stages::{StageSamples, StageTimes};
pub use states::{
    SceneState, SentValues, StateDecoder, StateLayout, StateRequest, StateStream, StateStreamOptions,
    StateStreamRequest,
};
pub use step::{DomainTransform, Step};
pub use step_stream::{Ack, DriveRequest, MAX_STALL_BUDGET, StepStream, StreamSummary};
pub use tonic::Code;
pub use vertex_sections::VertexSetDomain;
pub use vertices::{Attribute, Encoding, VertexRequest, VertexSelection, VertexSet, VertexStream, VertexStreamRequest};
