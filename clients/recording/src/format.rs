//! Names, limits and schemas of the format of recordings, which the README of this crate defines.

use modalcast_client::{Domain, SceneDescription, v1};
use prost::Message as _;
use prost_types::FileDescriptorSet;

/// The profile of the MCAP file.
pub const PROFILE: &str = "modalcast";

/// `version` in the metadata record `recording`.
pub const VERSION: &str = "1";

/// Encoding of schemas and messages.
pub(crate) const ENCODING: &str = "protobuf";

/// A chunk is closed when its records exceed this size in bytes.
pub(crate) const CHUNK_BYTES: u64 = 1 << 20;

/// Size limit of the records of a chunk that is read, in bytes, before and after decompression.
pub(crate) const MAX_CHUNK_BYTES: u64 = 64 << 20;

/// Size limit of a metadata record that is read, in bytes.
pub(crate) const MAX_METADATA_BYTES: u64 = 64 << 20;

/// Size limit of the description of a scene, without arrays, in bytes.
pub(crate) const MAX_SCENE_BYTES: u64 = 512 << 20;

/// Size limit of all contents of a scene in bytes. Larger scenes can be recorded only by hash.
pub(crate) const MAX_CONTENT_BYTES: u64 = 8 << 30;

/// Longest time in nanoseconds between two complete states, which have all values and not only changes.
pub(crate) const COMPLETE_INTERVAL: u64 = 2_000_000_000;

/// Largest number of states from one complete state to the next.
pub(crate) const COMPLETE_STATES: u64 = 1000;

/// Size limit of a state of a scene in bytes: twice the size of a complete state, so that sections which newer servers
/// add fit, too.
pub(crate) fn max_state_bytes(description: &SceneDescription) -> u64 {
    // q, two domain indices, a transform of 12 f32 and an origin of 3 f64.
    let domain_bytes = |domain: &Domain| 4 * domain.rank as u64 + 2 * 4 + 48 + 24;
    2 * description.domains.iter().map(domain_bytes).sum::<u64>() + 1024
}

/// Names of metadata records.
pub(crate) mod metadata {
    pub(crate) const RECORDING: &str = "recording";
    pub(crate) const SERVER: &str = "server";
    pub(crate) const CONTENT: &str = "content";
    pub(crate) const VIEW: &str = "view";

    pub(crate) const ALL: [&str; 4] = [RECORDING, SERVER, CONTENT, VIEW];
}

/// A topic of a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Topic {
    Scene,
    Content,
    States,
    Forces,
}

impl Topic {
    pub const ALL: [Self; 4] = [Self::Scene, Self::Content, Self::States, Self::Forces];

    /// The name in the file.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Scene => "scene",
            Self::Content => "content",
            Self::States => "states",
            Self::Forces => "forces",
        }
    }

    /// The full name of the message type.
    pub const fn schema_name(self) -> &'static str {
        match self {
            Self::Scene => "modalcast.v1.DescribeSceneResponse",
            Self::Content => "modalcast.v1.ReadContentResponse",
            Self::States => "modalcast.v1.StreamStatesResponse",
            Self::Forces => "modalcast.v1.StreamForcesResponse",
        }
    }

    /// The proto file of the message type.
    const fn proto_file(self) -> &'static str {
        match self {
            Self::Scene | Self::Content => "modalcast/v1/scenes.proto",
            Self::States => "modalcast/v1/states.proto",
            Self::Forces => "modalcast/v1/forces.proto",
        }
    }

    /// An encoded `FileDescriptorSet` with the proto file of the message type and its imports, without comments.
    ///
    /// # Errors
    /// If the descriptors of the contract cannot be decoded.
    pub(crate) fn schema(self) -> Result<Vec<u8>, prost::DecodeError> {
        let mut set = FileDescriptorSet::decode(v1::DESCRIPTORS)?;
        let mut names = vec![self.proto_file().to_owned()];
        let mut index = 0;
        while let Some(name) = names.get(index) {
            let imports = set.file.iter().filter(|file| file.name() == name).flat_map(|file| file.dependency.clone());
            let new_imports: Vec<String> = imports.filter(|import| !names.contains(import)).collect();
            names.extend(new_imports);
            index += 1;
        }
        set.file.retain(|file| names.iter().any(|name| name == file.name()));
        set.file.iter_mut().for_each(|file| file.source_code_info = None);
        Ok(set.encode_to_vec())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn schemas_have_the_message_and_all_imports() {
        for topic in Topic::ALL {
            let schema = topic.schema().expect("valid descriptors");
            assert!(schema.len() < 16 << 10, "expected no comments, got {} bytes", schema.len());
            let set = FileDescriptorSet::decode(&schema[..]).expect("a descriptor set");
            let names: Vec<&str> = set.file.iter().map(|file| file.name()).collect();
            let is_present = |import: &String| names.contains(&import.as_str());
            assert!(set.file.iter().all(|file| file.dependency.iter().all(is_present)), "{names:?}");
            let message = topic.schema_name().trim_start_matches("modalcast.v1.");
            assert!(set.file.iter().any(|file| file.message_type.iter().any(|found| found.name() == message)));
        }
    }
}
