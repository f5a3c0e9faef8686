//! The role that each method of the server requires.

use crate::identity::Role;

/// What a method requires of its caller.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Requirement {
    /// Nothing, not even a credential.
    Public,
    /// A principal with this role or a later one.
    Role(Role),
}

/// Every method of every service. A method that is not listed is denied.
const METHODS: [(&str, Requirement); 31] = {
    use Requirement::{Public, Role as Requires};
    use Role::{Admin, Drive, Interact, Pixels, Upload, View};
    [
        ("grpc.health.v1.Health/Check", Public),
        ("grpc.health.v1.Health/Watch", Requires(Pixels)),
        ("grpc.reflection.v1.ServerReflection/ServerReflectionInfo", Requires(Pixels)),
        ("grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo", Requires(Pixels)),
        ("modalcast.v1.ServerService/GetServerInfo", Requires(Pixels)),
        ("modalcast.v1.ServerService/CreateViewerLink", Requires(Pixels)),
        ("modalcast.v1.SceneService/ListScenes", Requires(Pixels)),
        ("modalcast.v1.FrameService/RenderFrame", Requires(Pixels)),
        ("modalcast.v1.FrameService/StreamFrames", Requires(Pixels)),
        ("modalcast.v1.FrameService/UpdateFrameStream", Requires(Pixels)),
        ("modalcast.v1.FrameService/Pick", Requires(View)),
        ("modalcast.v1.SceneService/DescribeScene", Requires(View)),
        ("modalcast.v1.SceneService/ReadContent", Requires(View)),
        ("modalcast.v1.SceneService/ReadModes", Requires(View)),
        ("modalcast.v1.VertexService/GetVertices", Requires(View)),
        ("modalcast.v1.VertexService/StreamVertices", Requires(View)),
        ("modalcast.v1.ViewService/DrawViews", Requires(View)),
        ("modalcast.v1.StateService/GetState", Requires(View)),
        ("modalcast.v1.StateService/StreamStates", Requires(View)),
        ("modalcast.v1.ForceService/StreamForces", Requires(View)),
        ("modalcast.v1.ForceService/ApplyForces", Requires(Interact)),
        ("modalcast.v1.SceneService/OpenScene", Requires(Drive)),
        ("modalcast.v1.SceneService/DeleteScene", Requires(Drive)),
        ("modalcast.v1.SceneService/ShareScene", Requires(Drive)),
        ("modalcast.v1.StepService/DriveScene", Requires(Drive)),
        ("modalcast.v1.StepService/ResetScene", Requires(Drive)),
        ("modalcast.v1.SceneService/FindUploadedFiles", Requires(Upload)),
        ("modalcast.v1.SceneService/UploadScene", Requires(Upload)),
        ("modalcast.v1.SceneService/UploadArrays", Requires(Upload)),
        ("modalcast.v1.ServerService/ListClients", Requires(Admin)),
        ("modalcast.v1.ServerService/EndClient", Requires(Admin)),
    ]
};

/// The requirement of a method, by the path of its URL. `None` for a method that does not exist or is not listed.
pub(super) fn requirement_of(path: &str) -> Option<Requirement> {
    let name = path.strip_prefix('/')?;
    METHODS.iter().find(|(method, _)| *method == name).map(|(_, requirement)| *requirement)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use prost::Message as _;
    use prost_types::FileDescriptorSet;

    use super::*;

    /// The paths of all methods in a set of encoded descriptors.
    fn methods_of(descriptors: &[u8]) -> BTreeSet<String> {
        let files = FileDescriptorSet::decode(descriptors).expect("expected descriptors").file;
        let mut methods = BTreeSet::new();
        for file in files {
            for service in &file.service {
                let path = |method: &prost_types::MethodDescriptorProto| {
                    format!("{}.{}/{}", file.package(), service.name(), method.name())
                };
                methods.extend(service.method.iter().map(path));
            }
        }
        methods
    }

    #[test]
    fn every_method_has_one_requirement() {
        let descriptors = [
            modalcast_proto::v1::DESCRIPTORS,
            tonic_health::pb::FILE_DESCRIPTOR_SET,
            tonic_reflection::pb::v1::FILE_DESCRIPTOR_SET,
            tonic_reflection::pb::v1alpha::FILE_DESCRIPTOR_SET,
        ];
        let methods: BTreeSet<String> = descriptors.into_iter().flat_map(methods_of).collect();
        let listed: BTreeSet<String> = METHODS.iter().map(|(method, _)| (*method).to_owned()).collect();
        assert_eq!(listed.len(), METHODS.len(), "expected each method once");
        assert_eq!(listed, methods);
    }

    /// The page that users read has the same table.
    #[test]
    fn documented_table_is_that_of_the_server() {
        let page = include_str!("../../deploy/identity.md");
        let cells_of = |line: &str| -> Option<(String, String)> {
            let (method, role) = line.strip_prefix("| `")?.strip_suffix(" |")?.split_once("` | ")?;
            method.contains('/').then(|| (method.to_owned(), role.trim_matches('`').to_owned()))
        };
        let documented: BTreeSet<_> = page.lines().filter_map(cells_of).collect();
        let name = |requirement: Requirement| match requirement {
            Requirement::Public => "nothing",
            Requirement::Role(role) => role.name(),
        };
        let listed: BTreeSet<_> =
            METHODS.iter().map(|(method, requirement)| ((*method).to_owned(), name(*requirement).to_owned())).collect();
        assert_eq!(documented, listed);
    }

    #[test]
    fn unlisted_paths_have_no_requirement() {
        for path in ["", "/", "/modalcast.v1.SceneService/", "modalcast.v1.SceneService/OpenScene", "/x/OpenScene"] {
            assert_eq!(requirement_of(path), None, "{path}");
        }
        let requirement = requirement_of("/modalcast.v1.SceneService/OpenScene");
        assert_eq!(requirement, Some(Requirement::Role(Role::Drive)));
    }
}
