//! Scene descriptions: each shape, material and texture once, content by hash, and the client's cache.

use std::sync::Arc;

use modalcast::engine::{SceneSource, StoredUpload};
use modalcast_client::{Client, DescriptionRequest, Error, Reason, SceneDescription, ShapeArray};
use modalcast_model::domain::{
    AlphaMode, Attachment, Domain, FollowConstraint, Inertia, Material, MaterialRange, Mesh, Metadata, Modes, Shape,
    Texture, Transform,
};
use modalcast_model::error::Result;
use modalcast_model::load::OpenedScene;
use modalcast_model::memory::MemoryReservation;
use modalcast_model::scene::{Scene, SceneParts};
use modalcast_proto::v1;
use prost::Message as _;
use sha2::{Digest as _, Sha256};
use tonic::Code;
use v1::describe_scene_response::Part;

use crate::service_harness::{MAX_MESSAGE_BYTES, Server, config, rejection_details, with_timeout};

const ALL_ARRAYS: [ShapeArray; 6] = [
    ShapeArray::Indices,
    ShapeArray::CornerVertices,
    ShapeArray::RestPositions,
    ShapeArray::Uvs,
    ShapeArray::RestNormals,
    ShapeArray::Modes,
];

struct OneScene(Arc<Scene>);

impl SceneSource for OneScene {
    fn open(&self, _: &str, _: &Arc<MemoryReservation>) -> Result<OpenedScene> {
        Ok(Arc::clone(&self.0).into())
    }

    fn open_upload(&self, upload: &StoredUpload, memory: &Arc<MemoryReservation>) -> Result<OpenedScene> {
        self.open(&upload.entry, memory)
    }

    fn list(&self) -> Vec<String> {
        vec![]
    }
}

/// A strip of triangles with `vertex_count` vertices and `rank` modes.
fn strip(vertex_count: usize, rank: usize, has_uvs: bool) -> Shape {
    let positions = (0..vertex_count).map(|vertex| [vertex as f32, (vertex % 3) as f32, 0.5]).collect();
    let uvs = if has_uvs { vec![[0.25, 0.75]; vertex_count] } else { vec![] };
    let triangles = (0..vertex_count as u32 - 2).map(|vertex| [vertex, vertex + 1, vertex + 2]).collect();
    let mesh = Mesh::from_indexed(positions, vec![[0.0, 0.0, 1.0]; vertex_count], uvs, triangles);
    let entries = (0..3 * vertex_count * rank).map(|entry| (entry % 97) as f32).collect();
    let modes = if rank > 0 { Modes::from_columns(3 * vertex_count, rank, entries) } else { Ok(Modes::rigid()) };
    Shape::new(mesh.expect("expected a valid mesh"), modes.expect("expected valid modes")).expect("expected a shape")
}

/// The mass properties of a shoot with six modes. All numbers differ.
fn inertia_of_shoot(plant: usize) -> Inertia {
    let momenta = (0..36).map(|entry| 1e-3 * f64::from(entry)).collect();
    let mass =
        |row: i32, column: i32| if row == column { 1.0 + f64::from(row) } else { 0.01 * f64::from(row + column) };
    let masses = (0..36).map(|entry| mass(entry / 6, entry % 6)).collect();
    Inertia::new(2.0 + 1e-3 * plant as f64, [0.1, 0.2, 0.3], [5.0, 6.0, 7.0, 0.1, 0.2, 0.3], momenta, masses)
        .expect("expected valid masses")
}

/// Plants of four domains: a shoot with six modes, and three rigid leaves that follow it. All shoots have one shape,
/// and the leaves of a plant have three shapes. Two materials share a texture.
fn orchard(plant_count: usize) -> Arc<Scene> {
    let shapes = vec![strip(9000, 6, false), strip(12, 0, true), strip(13, 0, true), strip(14, 0, true)];
    let pixels = (0..4 * 8 * 4).map(|byte| byte as u8).collect();
    let textures = vec![Texture::new("leaf.png", 8, 4, pixels).expect("expected a valid texture")];
    let leaf = Material { name: "leaf".into(), color_texture: Some(0), double_sided: true, ..Material::default() };
    let edge = Material { name: "edge".into(), alpha_mode: AlphaMode::Mask { cutoff: 0.25 }, ..leaf.clone() };
    let bark = Material { name: "bark".into(), diffuse: [0.5, 0.25, 0.125], shininess: 7.0, ..Material::default() };
    let frame = Transform([0.6, 0.8, 0.0, 0.1, -0.8, 0.6, 0.0, 0.5, 0.0, 0.0, 1.0, 0.25]);
    let mut domains = Vec::new();
    for plant in 0..plant_count {
        let eigenvalues = (1..7).map(f64::from).collect();
        let placement = Transform([1.0, 0.0, 0.0, plant as f32, 0.0, 1.0, 0.0, 0.5, 0.0, 0.0, 1.0, 0.25]);
        // The last shoot has no inertia.
        let inertia = (plant + 1 < plant_count).then(|| inertia_of_shoot(plant));
        let metadata = Metadata { eigenvalues, inertia, notes: [("kind".into(), "shoot".into())].into() };
        let shoot = domains.len();
        domains.push(Domain { placement, metadata, ..Domain::new(format!("plant {plant}"), 0) });
        for shape in 1..4 {
            let material_ranges =
                [(0, 1), (3, 2)].map(|(first_triangle, material)| MaterialRange { first_triangle, material });
            domains.push(Domain {
                material: 1,
                material_ranges: material_ranges.into(),
                attachment: Some(Attachment { parent: shoot, frame, vertices: vec![1, 2, 3, 4] }),
                follows: Some(FollowConstraint { parent: shoot, frame }),
                ..Domain::new(format!("plant {plant}/leaf {shape}"), shape)
            });
        }
    }
    // The second shoot has other eigenvalues than the first one, the third has none.
    domains[4].metadata.eigenvalues[0] = 0.5;
    domains[8].metadata.eigenvalues.clear();
    let materials = vec![bark, leaf, edge];
    Scene::new(SceneParts { shapes, materials, textures, domains, ..SceneParts::named("orchard") })
        .expect("expected a valid scene")
}

/// A server with the open scene `orchard`, and its state folder.
async fn start_orchard(scene: &Arc<Scene>) -> (Server, Client, tempfile::TempDir) {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let server = Server::start_from(config(folder.path()), Arc::new(OneScene(Arc::clone(scene)))).await;
    server.open("orchard").await;
    let client = Client::connect(&server.address).await.expect("expected a connection");
    (server, client, folder)
}

/// The arrays of a shape as bytes, in the order of [`ALL_ARRAYS`].
fn array_bytes(shape: &Shape) -> [Vec<u8>; 6] {
    let (mesh, modes) = (&shape.mesh, &shape.modes);
    let rows = (0..3 * modes.vertices()).flat_map(|row| (0..modes.rank()).map(move |mode| modes.column(mode)[row]));
    [
        bytemuck::cast_slice(mesh.triangles()).to_vec(),
        bytemuck::cast_slice(&mesh.corners().vertices).to_vec(),
        bytemuck::cast_slice(mesh.rest_positions()).to_vec(),
        bytemuck::cast_slice(&mesh.corners().uvs).to_vec(),
        bytemuck::cast_slice(&mesh.corners().normals).to_vec(),
        rows.flat_map(f32::to_le_bytes).collect(),
    ]
}

/// The array that a description holds, as bytes.
fn described_array(shape: &modalcast_client::Shape, array: ShapeArray) -> Vec<u8> {
    match array {
        ShapeArray::Indices => bytemuck::cast_slice(&shape.indices).to_vec(),
        ShapeArray::CornerVertices => bytemuck::cast_slice(&shape.corner_vertices).to_vec(),
        ShapeArray::RestPositions => bytemuck::cast_slice(&shape.rest_positions).to_vec(),
        ShapeArray::Uvs => bytemuck::cast_slice(&shape.uvs).to_vec(),
        ShapeArray::RestNormals => bytemuck::cast_slice(&shape.rest_normals).to_vec(),
        ShapeArray::Modes => bytemuck::cast_slice(&shape.modes).to_vec(),
        // No shape of these tests is far from its origin.
        ShapeArray::CenteredPositions | ShapeArray::Unspecified => vec![],
    }
}

/// Asserts that a description contains the whole scene, arrays and pixels included.
fn assert_describes(description: &SceneDescription, scene: &Scene) {
    assert_eq!(description.domains.len(), scene.domains.len());
    for (described, shape) in description.shapes.iter().zip(&scene.shapes) {
        let arrays = ALL_ARRAYS.map(|array| described_array(described, array));
        assert!(arrays == array_bytes(shape), "expected equal arrays of shape {}", described.index);
    }
    for (described, domain) in description.domains.iter().zip(&scene.domains) {
        assert_eq!(
            (&described.name, described.shape, described.material),
            (&domain.name, domain.shape, domain.material)
        );
        assert_eq!((&described.eigenvalues, &described.notes), (&domain.metadata.eigenvalues, &domain.metadata.notes));
        let inertia = domain.metadata.inertia.as_ref().map(|inertia| modalcast_client::Inertia {
            mass: inertia.mass(),
            center: inertia.center(),
            moments: inertia.moments(),
            modal_momenta: inertia.modal_momenta().to_vec(),
            modal_masses: inertia.modal_masses().to_vec(),
        });
        assert_eq!(described.inertia, inertia);
        assert_eq!(described.placement, domain.placement.0);
        let attachment = described.attachment.as_ref().map(|joint| (joint.parent, joint.parent_from_child));
        assert_eq!(attachment, domain.attachment.as_ref().map(|joint| (joint.parent, joint.frame.0)));
        let follow = described.follow.as_ref().map(|follow| (follow.leader, follow.leader_from_follower));
        assert_eq!(follow, domain.follows.map(|follow| (follow.parent, follow.frame.0)));
        let ranges = described.material_ranges.iter().map(|range| (range.first_triangle, range.material));
        assert!(ranges.eq(domain.material_ranges.iter().map(|range| (range.first_triangle, range.material))));
    }
    let [bark, leaf, edge] = &description.materials[..] else { panic!("{:?}", description.materials) };
    assert_eq!((bark.diffuse, bark.shininess, bark.color_texture), ([0.5, 0.25, 0.125], 7.0, None));
    assert_eq!((leaf.alpha_mode, leaf.double_sided, leaf.color_texture), (v1::AlphaMode::Opaque, true, Some(0)));
    assert_eq!((edge.alpha_mode, edge.alpha_cutoff), (v1::AlphaMode::Mask, 0.25));
    let [texture] = &description.textures[..] else { panic!("{:?}", description.textures) };
    assert_eq!((texture.width, texture.height, &texture.pixels[..]), (8, 4, scene.textures[0].rgba()));
}

/// Only the messages of domains grow with the number of domains; those of shapes, materials and textures do not.
#[tokio::test(flavor = "multi_thread")]
async fn arrays_of_a_shape_are_sent_once_for_all_its_domains() {
    let plant_count = 1500;
    let scene = orchard(plant_count);
    let (server, ..) = start_orchard(&scene).await;
    let arrays = ALL_ARRAYS.map(Into::into).into();
    let request = v1::DescribeSceneRequest { scene: "orchard".into(), arrays, ..Default::default() };
    let mut stream = server.scenes().await.describe_scene(request).await.expect("expected a description").into_inner();
    let (mut array_bytes_received, mut domain_bytes, mut other_bytes) = (0, 0, 0);
    while let Some(response) = with_timeout(stream.message()).await.expect("expected another message") {
        assert!(response.encoded_len() <= MAX_MESSAGE_BYTES);
        match response.part.as_ref().expect("expected a part") {
            Part::Chunk(chunk) => array_bytes_received += chunk.data.len(),
            Part::Domains(_) => domain_bytes += response.encoded_len(),
            _ => other_bytes += response.encoded_len(),
        }
    }
    let expected: usize = scene.shapes.iter().flat_map(array_bytes).map(|bytes| bytes.len()).sum();
    assert_eq!(array_bytes_received, expected);
    // A plant has four domains. A leaf has two transforms of 48 bytes, a name of at most 19 bytes, and indices. The
    // inertia of a shoot has 82 numbers.
    assert!(domain_bytes <= plant_count * (4 * 180 + 82 * 8 + 20), "{domain_bytes} bytes of domains");
    assert!(other_bytes <= 8192, "{other_bytes} bytes of shapes, materials and textures");
}

#[tokio::test(flavor = "multi_thread")]
async fn client_describes_all_parts_directly_and_through_a_cache() {
    let scene = orchard(3);
    let (server, client, folder) = start_orchard(&scene).await;
    let request = DescriptionRequest::new("orchard").arrays(&ALL_ARRAYS).textures();
    let direct = client.describe_with(&request).await.expect("expected a description");
    assert_describes(&direct, &scene);
    let cache = folder.path().join("cache");
    let cached_request = request.clone().cache(&cache);
    let first = client.describe_with(&cached_request).await.expect("expected a description");
    assert_describes(&first, &scene);
    // A client that accepts no content can describe the scene only from the cache.
    let restricted = Client::connect(&server.address).await.expect("expected a connection").with_reply_limit(0);
    let second = restricted.describe_with(&cached_request).await.expect("expected a description from the cache");
    assert_describes(&second, &scene);
    let error = restricted.describe_with(&request).await.expect_err("control: expected an error without a cache");
    assert!(matches!(error, Error::Malformed { .. }), "{error}");
    // A damaged file is fetched again.
    let hash = first.shapes[0].hash_of(ShapeArray::Modes).expect("expected a hash");
    let name: String = hash.iter().map(|byte| format!("{byte:02x}")).collect();
    std::fs::write(cache.join(&name), b"damaged").expect("expected a file of this name in the cache");
    assert!(restricted.describe_with(&cached_request).await.is_err(), "control: expected another fetch");
    let third = client.describe_with(&cached_request).await.expect("expected a description");
    assert_describes(&third, &scene);
    let file = std::fs::read(cache.join(&name)).expect("expected the file");
    assert_eq!(Sha256::digest(file)[..], hash);
}

#[tokio::test(flavor = "multi_thread")]
async fn selected_domains_come_with_shapes_and_materials() {
    let (_server, client, _folder) = start_orchard(&orchard(3)).await;
    let request = DescriptionRequest::new("orchard").domains(&[11, 7]);
    let description = client.describe_with(&request).await.expect("expected a description");
    let shapes: Vec<_> = description.shapes.iter().map(|shape| (shape.index, shape.vertex_count)).collect();
    assert_eq!(shapes, [(3, 14)], "expected the shape of both leaves");
    assert!(description.shapes[0].hashes.is_empty() && description.textures[0].hash.is_none());
    let domains: Vec<_> = description.domains.iter().map(|domain| (domain.index, domain.shape)).collect();
    assert_eq!(domains, [(11, 0), (7, 0)]);
    let materials: Vec<_> = description.materials.iter().map(|material| (material.index, &material.name[..])).collect();
    assert_eq!(materials, [(1, "leaf"), (2, "edge")]);
    assert_eq!(description.domains[0].material_ranges[1].material, 1, "expected an index in `materials`");
}

#[tokio::test(flavor = "multi_thread")]
async fn unknown_and_malformed_hashes_are_rejected() {
    let (server, client, _folder) = start_orchard(&orchard(3)).await;
    let request = DescriptionRequest::new("orchard").hashes();
    let description = client.describe_with(&request).await.expect("expected a description");
    let known = description.textures[0].hash.expect("expected a hash");
    let contents = client.read_content("orchard", &[known, known]).await.expect("expected the pixels twice");
    assert_eq!((contents.len(), &contents[0]), (2, &contents[1]));
    let error = client.read_content("orchard", &[known, [7; 32]]).await.expect_err("expected an unknown hash");
    let rejection = error.rejection().expect("expected details");
    assert_eq!((rejection.reason, rejection.field.as_str()), (Reason::ContentNotFound, "sha256[1]"));
    assert_eq!(rejection.given, "07".repeat(32));
    for (sha256, field) in [(vec![], "sha256"), (vec![vec![1; 31].into()], "sha256[0]")] {
        let request = v1::ReadContentRequest { scene: "orchard".into(), sha256 };
        let status = server.scenes().await.read_content(request).await.expect_err("expected an invalid hash");
        assert_eq!((status.code(), rejection_details(&status).field.as_str()), (Code::InvalidArgument, field));
    }
}
