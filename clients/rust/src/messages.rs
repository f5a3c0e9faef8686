//! Replies as the messages of the wire contract, for programs that store or forward them.

use modalcast_proto::v1;
use v1::force_service_client::ForceServiceClient;
use v1::state_service_client::StateServiceClient;

use crate::assemble::Replies;
use crate::client::Client;
use crate::error::Result;
use crate::request::Delivery;

impl Client {
    /// Gets the messages of a description.
    ///
    /// # Errors
    /// `Status` if the server rejects the request; `Connect` if the connection is lost.
    pub async fn description_messages(
        &self,
        request: v1::DescribeSceneRequest,
    ) -> Result<Replies<v1::DescribeSceneResponse>> {
        self.replies(self.scene_streams().describe_scene(request).await)
    }

    /// Gets the messages of arrays and textures, without comparing them with their hashes.
    ///
    /// # Errors
    /// As [`Self::description_messages`].
    pub async fn content_messages(&self, request: v1::ReadContentRequest) -> Result<Replies<v1::ReadContentResponse>> {
        self.replies(self.scene_streams().read_content(request).await)
    }

    /// Subscribes to the messages of states. When this returns, the server has accepted the subscription.
    ///
    /// # Errors
    /// As [`Self::description_messages`].
    pub async fn state_messages(&self, request: v1::StreamStatesRequest) -> Result<Replies<v1::StreamStatesResponse>> {
        let delivery = match request.delivery() {
            v1::Delivery::Lossless => Delivery::Lossless,
            v1::Delivery::Latest | v1::Delivery::Unspecified => Delivery::Latest,
        };
        self.replies(StateServiceClient::new(self.channel_for(delivery)).stream_states(request).await)
    }

    /// Subscribes to the messages of forces.
    ///
    /// # Errors
    /// As [`Self::description_messages`].
    pub async fn force_messages(&self, request: v1::StreamForcesRequest) -> Result<Replies<v1::StreamForcesResponse>> {
        self.replies(ForceServiceClient::new(self.undecoded_channel()).stream_forces(request).await)
    }
}
