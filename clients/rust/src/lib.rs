#![doc = include_str!("../README.md")]
#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout))]

mod assemble;
mod client;
mod drive;
mod error;
mod frames;
pub mod npy;
mod pick;
mod scene;
mod step;
mod upload;
mod vertices;

pub use client::{Client, REPLY_LIMIT};
pub use drive::{Ack, Policy, StepStream, StreamSummary};
pub use error::{Error, Rejection, Result};
pub use frames::{
    Camera, Delivery, DrawnBy, Frame, FrameFormat, FrameRequest, FrameStream, FrameStreamRequest, Lens, Output,
    Picture, StageTimes, View,
};
pub use modalcast_proto::v1;
pub use modalcast_proto::v1::{SceneInfo, StepId};
pub use pick::{Hit, PickRequest, PickResult};
pub use scene::{Array, Attachment, Domain, ModeRows, SceneDescription, ServerInfo};
pub use step::{DomainTransform, Step};
pub use tonic::Code;
pub use vertices::{ReadbackOptions, VertexRequest, VertexSet, VertexStream, VertexStreamRequest};

/// Compiles the client code in the project's README as a doctest.
#[cfg(doctest)]
#[doc = include_str!("../../../README.md")]
struct ProjectReadme;
