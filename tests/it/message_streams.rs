//! The streams that a client subscribes to, behind one type, for tests that treat all of them alike.

use std::pin::Pin;

use modalcast_proto::v1;
use tokio_stream::{Stream, StreamExt as _};
use tonic::transport::Channel;
use tonic::{Response, Status, Streaming};
use v1::force_service_client::ForceServiceClient;
use v1::frame_service_client::FrameServiceClient;
use v1::state_service_client::StateServiceClient;
use v1::vertex_service_client::VertexServiceClient;

/// The sizes of the messages of a stream, in bytes.
pub(crate) type MessageSizes = Pin<Box<dyn Stream<Item = Result<usize, Status>> + Send>>;

/// A stream that a client subscribes to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum StreamKind {
    /// One picture per step.
    Frames,
    /// Two pictures per step: color and normals.
    Pictures,
    Vertices,
    States,
    Forces,
}

impl StreamKind {
    pub(crate) const ALL: [Self; 5] = [Self::Frames, Self::Pictures, Self::Vertices, Self::States, Self::Forces];

    /// Subscribes to a scene. Streams of forces ignore `delivery`. A frame of 640 x 360 pixels has 0.9 MB.
    pub(crate) async fn subscribe(
        self,
        channel: &Channel,
        scene: &str,
        delivery: v1::Delivery,
    ) -> Result<MessageSizes, Status> {
        let (channel, scene, delivery) = (channel.clone(), scene.to_owned(), delivery.into());
        let color = v1::Picture { width: 640, height: 360, format: v1::Format::Rgba.into(), ..Default::default() };
        let normals = v1::Picture { output: v1::Output::Normals.into(), format: 0, ..color.clone() };
        let pictures = if self == Self::Pictures { vec![color, normals] } else { vec![color] };
        match self {
            Self::Frames | Self::Pictures => {
                let request = v1::StreamFramesRequest { scene, pictures, delivery, ..Default::default() };
                FrameServiceClient::new(channel).stream_frames(request).await.map(message_sizes)
            }
            Self::Vertices => {
                let request = v1::StreamVerticesRequest { scene, delivery, ..Default::default() };
                VertexServiceClient::new(channel).stream_vertices(request).await.map(message_sizes)
            }
            Self::States => {
                let request = v1::StreamStatesRequest { scene, delivery, ..Default::default() };
                StateServiceClient::new(channel).stream_states(request).await.map(message_sizes)
            }
            Self::Forces => {
                let request = v1::StreamForcesRequest { scene, max_hz: 0.0, passive: false };
                ForceServiceClient::new(channel).stream_forces(request).await.map(message_sizes)
            }
        }
    }
}

/// The sizes of the messages of a reply.
pub(crate) fn message_sizes<T: prost::Message + 'static>(reply: Response<Streaming<T>>) -> MessageSizes {
    Box::pin(reply.into_inner().map(|message| message.map(|message| message.encoded_len())))
}
