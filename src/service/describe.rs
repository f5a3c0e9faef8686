//! Describes a scene for clients that do not have its files: shapes, materials, textures and domains, each once, and
//! the arrays of the shapes. Replies are sent in messages of about 1 MiB. A message is built after it has capacity in the
//! reply budget, so a call that waits holds little more than its request.

use std::ops::Range;
use std::sync::Arc;

use bytes::Bytes;
use modalcast_proto::v1;
use modalcast_proto::v1::describe_scene_response::Part;
use tonic::{Response, Status};

use super::MAX_REPLY_BYTES;
use super::convert::{parse_hashes, wire_scene_info};
use super::reply_budget::CallReplies;
use super::status::to_status;
use super::stream::{ReplySender, ReplyStream, respond};
use crate::engine::{ContentHash, ContentHashes, SceneContent, SceneHandle, ShapeArray, hex, run_blocking};
use modalcast_model::domain::{AlphaMode, Domain, Inertia, Material, MaterialRange, Transform};
use modalcast_model::error::{Error, Result, invalid};
use modalcast_model::scene::Scene;

/// Upper bound on the encoded size of a chunk without its data, in bytes.
const CHUNK_HEAD_BYTES: usize = 64;

/// Replies with the descriptions of the selected domains and of everything that they use, and with the requested
/// arrays.
pub(super) fn respond_with_description(
    replies: Arc<CallReplies>,
    scene_handle: Arc<SceneHandle>,
    request: v1::DescribeSceneRequest,
    max_chunk_bytes: usize,
) -> Result<Response<ReplyStream<v1::DescribeSceneResponse>>> {
    let selection = Arc::new(Selection::new("domains", request.domains, scene_handle.scene.domains.len())?);
    let arrays = parse_arrays(&request.arrays)?;
    Ok(respond(replies, move |reply_sender| async move {
        reply_sender.send(response_with(Part::Scene(wire_scene_info(&scene_handle)))).await?;
        let hashes = match request.hashes {
            true => Some(scene_handle.content_hashes().await.map_err(to_status)?),
            false => None,
        };
        let scene = &scene_handle.scene;
        let mut position = Some(Position::START);
        while let Some(start) = position {
            // A single item may be as large as a message may be.
            let permit = reply_sender.reserve(MAX_REPLY_BYTES).await?;
            let (scene, selection, hashes) = (Arc::clone(scene), Arc::clone(&selection), hashes.clone());
            let describe = move || {
                // Computed again for each part, so that a call that waits holds no lists of domains and shapes.
                let used = UsedContent::new(&scene, &selection);
                let description =
                    Description { scene: &scene, selection: &selection, used: &used, hashes: hashes.as_deref() };
                let (part, end) = description.part(start, max_chunk_bytes);
                Ok((part, description.next_position(end)))
            };
            let (part, next_position) = run_blocking("describe", describe).await.map_err(to_status)?;
            permit.send(response_with(part))?;
            position = next_position;
        }
        let shapes = if arrays.is_empty() { vec![] } else { UsedContent::new(scene, &selection).shape_ranges() };
        for shape in shapes.into_iter().flatten() {
            for array in &arrays {
                send_array(scene, shape, *array, max_chunk_bytes, &reply_sender).await?;
            }
        }
        Ok(())
    }))
}

/// Indices that a request selects: those that it lists, or all.
struct Selection {
    /// Empty for all.
    listed: Vec<u32>,
    /// Number of all indices.
    count: usize,
}

impl Selection {
    /// Checks a list of indices of `count` objects; an empty list means all in order. `field` names the list in errors.
    ///
    /// # Errors
    /// `Invalid` when an index is out of range or there are more indices than objects.
    fn new(field: &str, listed: Vec<u32>, count: usize) -> Result<Self> {
        if listed.len() > count {
            return Err(invalid(field, format!("at most {count} indices"), listed.len()));
        }
        match listed.iter().position(|index| *index as usize >= count) {
            None => Ok(Self { listed, count }),
            Some(position) => {
                let expected = format!("an index below {count}");
                Err(invalid(format!("{field}[{position}]"), expected, listed[position]))
            }
        }
    }

    fn len(&self) -> usize {
        if self.listed.is_empty() { self.count } else { self.listed.len() }
    }

    /// The selected indices from a position on, in the order of the reply.
    fn from(&self, position: usize) -> impl Iterator<Item = u32> {
        (position..self.len()).map(|position| self.listed.get(position).copied().unwrap_or(position as u32))
    }
}

/// Sends an array in chunks. An empty array is one empty chunk.
async fn send_array(
    scene: &Arc<Scene>,
    shape: usize,
    array: ShapeArray,
    max_chunk_bytes: usize,
    reply_sender: &ReplySender<v1::DescribeSceneResponse>,
) -> Result<(), Status> {
    let size = array.size(&scene.shapes[shape]);
    for start in (0..size.max(1)).step_by(max_chunk_bytes) {
        let permit = reply_sender.reserve(max_chunk_bytes.min(size) + CHUNK_HEAD_BYTES).await?;
        let chunk = v1::ArrayChunk {
            shape: shape as u32,
            array: wire_array(array).into(),
            offset: start as u64,
            total: size as u64,
            data: array.read(scene, shape, start..size.min(start + max_chunk_bytes)),
        };
        permit.send(response_with(Part::Chunk(chunk)))?;
    }
    Ok(())
}

/// Replies with arrays and textures by their hashes.
pub(super) async fn respond_with_content(
    replies: Arc<CallReplies>,
    scene_handle: Arc<SceneHandle>,
    request: v1::ReadContentRequest,
    max_chunk_bytes: usize,
) -> Result<Response<ReplyStream<v1::ReadContentResponse>>> {
    let requested_hashes = parse_hashes(&request.sha256)?;
    let hashes = scene_handle.content_hashes().await?;
    let find_content = |(index, hash): (usize, &ContentHash)| {
        let not_found = || {
            let field = format!("sha256[{index}]");
            Error::ContentNotFound { field, what: "array or texture of the scene", sha256: hex(hash) }
        };
        hashes.find(hash).ok_or_else(not_found)
    };
    let items: Vec<SceneContent> = requested_hashes.iter().enumerate().map(find_content).collect::<Result<_>>()?;
    Ok(respond(replies, move |reply_sender: ReplySender<v1::ReadContentResponse>| async move {
        for (item, content) in items.into_iter().enumerate() {
            let size = content.size(&scene_handle.scene);
            for start in (0..size.max(1)).step_by(max_chunk_bytes) {
                let permit = reply_sender.reserve(max_chunk_bytes.min(size) + CHUNK_HEAD_BYTES).await?;
                let data = content.read(&scene_handle.scene, start..size.min(start + max_chunk_bytes));
                let (item, offset, total) = (item as u32, start as u64, size as u64);
                permit.send(v1::ReadContentResponse { item, offset, total, data })?;
            }
        }
        Ok(())
    }))
}

/// Replies with rows of one domain's U: three per requested vertex.
pub(super) fn respond_with_modes(
    replies: Arc<CallReplies>,
    scene_handle: Arc<SceneHandle>,
    request: v1::ReadModesRequest,
    max_chunk_bytes: usize,
) -> Result<Response<ReplyStream<v1::ReadModesResponse>>> {
    let domain_count = scene_handle.scene.domains.len();
    if request.domain as usize >= domain_count {
        return Err(invalid("domain", format!("an index below {domain_count}"), request.domain));
    }
    let shape = scene_handle.scene.shape_of(request.domain as usize);
    let (vertex_count, rank) = (shape.mesh.rest_positions().len(), shape.modes.rank());
    let selection = Selection::new("vertices", request.vertices, vertex_count)?;
    // Three rows of `rank` f32.
    let bytes_per_vertex = 12 * rank;
    // A chunk has whole vertices, and only one chunk is in memory at a time. Without modes, one message without data is
    // the reply.
    let vertices_per_chunk = if rank == 0 { selection.len() } else { (max_chunk_bytes / bytes_per_vertex).max(1) };
    let total = (bytes_per_vertex * selection.len()) as u64;
    Ok(respond(replies, move |reply_sender: ReplySender<v1::ReadModesResponse>| async move {
        let modes = &scene_handle.scene.shape_of(request.domain as usize).modes;
        for first in (0..selection.len()).step_by(vertices_per_chunk) {
            let chunk_vertices = vertices_per_chunk.min(selection.len() - first);
            let permit = reply_sender.reserve(chunk_vertices * bytes_per_vertex + CHUNK_HEAD_BYTES).await?;
            let entries_of_row = |row: usize| (0..rank).map(move |mode| modes.column(mode)[row]);
            let rows = selection
                .from(first)
                .take(chunk_vertices)
                .flat_map(|vertex| (0..3).map(move |component| 3 * vertex as usize + component));
            let data: Vec<u8> = rows.flat_map(entries_of_row).flat_map(f32::to_le_bytes).collect();
            let offset = (first * bytes_per_vertex) as u64;
            permit.send(v1::ReadModesResponse { rank: rank as u32, offset, total, data: data.into() })?;
        }
        Ok(())
    }))
}

const fn response_with(part: Part) -> v1::DescribeSceneResponse {
    v1::DescribeSceneResponse { part: Some(part) }
}

fn parse_arrays(numbers: &[i32]) -> Result<Vec<ShapeArray>> {
    let mut arrays = Vec::new();
    for (index, number) in numbers.iter().enumerate() {
        let array = match v1::Array::try_from(*number) {
            Ok(v1::Array::Indices) => ShapeArray::Indices,
            Ok(v1::Array::CornerVertices) => ShapeArray::CornerVertices,
            Ok(v1::Array::RestPositions) => ShapeArray::RestPositions,
            Ok(v1::Array::Uvs) => ShapeArray::Uvs,
            Ok(v1::Array::RestNormals) => ShapeArray::RestNormals,
            Ok(v1::Array::Modes) => ShapeArray::Modes,
            Ok(v1::Array::CenteredPositions) => ShapeArray::CenteredPositions,
            Ok(v1::Array::Unspecified) | Err(_) => {
                return Err(invalid(format!("arrays[{index}]"), "an array of this version", number));
            }
        };
        if arrays.contains(&array) {
            let given = wire_array(array).as_str_name();
            return Err(invalid(format!("arrays[{index}]"), "each array at most once", given));
        }
        arrays.push(array);
    }
    Ok(arrays)
}

const fn wire_array(array: ShapeArray) -> v1::Array {
    match array {
        ShapeArray::Indices => v1::Array::Indices,
        ShapeArray::CornerVertices => v1::Array::CornerVertices,
        ShapeArray::RestPositions => v1::Array::RestPositions,
        ShapeArray::Uvs => v1::Array::Uvs,
        ShapeArray::RestNormals => v1::Array::RestNormals,
        ShapeArray::Modes => v1::Array::Modes,
        ShapeArray::CenteredPositions => v1::Array::CenteredPositions,
    }
}

/// A kind of items in a description.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum DescriptionKind {
    Shapes,
    Materials,
    Textures,
    Domains,
}

/// An item of a description.
#[derive(Debug, Clone, Copy)]
struct Position {
    kind: DescriptionKind,
    /// Number of items of this kind before it.
    index: usize,
}

impl Position {
    /// A scene has at least one domain, and every domain has a shape.
    const START: Self = Self { kind: DescriptionKind::Shapes, index: 0 };
}

/// What the selected domains of a scene use.
struct UsedContent {
    /// Indices of the shapes, materials and textures, ascending.
    shapes: Vec<u32>,
    materials: Vec<u32>,
    textures: Vec<u32>,
    /// Per shape of the scene, the first domain that has it. The eigenvalues of a shape are those of this domain.
    first_domains: Vec<Option<u32>>,
}

impl UsedContent {
    fn new(scene: &Scene, selection: &Selection) -> Self {
        let mut first_domains = vec![None; scene.shapes.len()];
        for (index, domain) in scene.domains.iter().enumerate() {
            first_domains[domain.shape].get_or_insert(index as u32);
        }
        let selected_domains = || selection.from(0).map(|index| &scene.domains[index as usize]);
        let shapes = used_indices(scene.shapes.len(), selected_domains().map(|domain| domain.shape));
        let materials = used_indices(scene.materials.len(), selected_domains().flat_map(Domain::materials));
        let textures_of = |material: &u32| {
            let material = &scene.materials[*material as usize];
            [material.color_texture, material.normal_texture].into_iter().flatten()
        };
        let textures = used_indices(scene.textures.len(), materials.iter().flat_map(textures_of));
        Self { shapes, materials, textures, first_domains }
    }

    /// The indices of the shapes as ranges of consecutive indices.
    fn shape_ranges(&self) -> Vec<Range<usize>> {
        self.shapes
            .chunk_by(|shape, next_shape| shape + 1 == *next_shape)
            .map(|consecutive| {
                let first = consecutive[0] as usize;
                first..first + consecutive.len()
            })
            .collect()
    }
}

/// The parts of a scene that a reply describes.
struct Description<'a> {
    scene: &'a Scene,
    selection: &'a Selection,
    used: &'a UsedContent,
    /// Present if hashes were requested.
    hashes: Option<&'a ContentHashes>,
}

impl Description<'_> {
    /// Number of items of a kind.
    fn count(&self, kind: DescriptionKind) -> usize {
        match kind {
            DescriptionKind::Shapes => self.used.shapes.len(),
            DescriptionKind::Materials => self.used.materials.len(),
            DescriptionKind::Textures => self.used.textures.len(),
            DescriptionKind::Domains => self.selection.len(),
        }
    }

    /// The first item at a position or after it, or `None` at the end.
    fn next_position(&self, mut position: Position) -> Option<Position> {
        while position.index == self.count(position.kind) {
            let kind = match position.kind {
                DescriptionKind::Shapes => DescriptionKind::Materials,
                DescriptionKind::Materials => DescriptionKind::Textures,
                DescriptionKind::Textures => DescriptionKind::Domains,
                DescriptionKind::Domains => return None,
            };
            position = Position { kind, index: 0 };
        }
        Some(position)
    }

    /// Describes items of one kind from a position on, in about `max_bytes` bytes: as many as fit, and at least one.
    /// Returns also the position after them.
    fn part(&self, Position { kind, index }: Position, max_bytes: usize) -> (Part, Position) {
        let position_after = |count: usize| Position { kind, index: index + count };
        let describe_material = |index: u32| wire_material(index as usize, &self.scene.materials[index as usize]);
        match kind {
            DescriptionKind::Shapes => {
                let indices = self.used.shapes[index..].iter().copied();
                let shapes = take_fitting(indices.map(|shape| self.describe_shape(shape as usize)), max_bytes);
                let count = shapes.len();
                (Part::Shapes(v1::ShapeDescriptions { shapes }), position_after(count))
            }
            DescriptionKind::Materials => {
                let indices = self.used.materials[index..].iter().copied();
                let materials = take_fitting(indices.map(describe_material), max_bytes);
                let count = materials.len();
                (Part::Materials(v1::MaterialDescriptions { materials }), position_after(count))
            }
            DescriptionKind::Textures => {
                let indices = self.used.textures[index..].iter().copied();
                let textures = take_fitting(indices.map(|texture| self.describe_texture(texture as usize)), max_bytes);
                let count = textures.len();
                (Part::Textures(v1::TextureDescriptions { textures }), position_after(count))
            }
            DescriptionKind::Domains => {
                let indices = self.selection.from(index);
                let domains = take_fitting(indices.map(|domain| self.describe_domain(domain)), max_bytes);
                let count = domains.len();
                (Part::Domains(v1::DomainDescriptions { domains }), position_after(count))
            }
        }
    }

    fn describe_shape(&self, index: usize) -> v1::ShapeDescription {
        let shape = &self.scene.shapes[index];
        let array_hashes = self.hashes.map(|hashes| hashes.of_shape(index));
        let describe_array = |(ordinal, array): (usize, ShapeArray)| v1::ArrayDescription {
            array: wire_array(array).into(),
            bytes: array.size(shape) as u64,
            sha256: array_hashes.map(|hashes| hashes[ordinal].to_vec().into()).unwrap_or_default(),
        };
        let is_described =
            |(_, array): &(usize, ShapeArray)| *array != ShapeArray::CenteredPositions || shape.is_centered();
        v1::ShapeDescription {
            shape: index as u32,
            vertices: shape.mesh.rest_positions().len() as u32,
            rank: shape.modes.rank() as u32,
            corners: shape.mesh.corners().vertices.len() as u32,
            triangles: shape.mesh.triangles().len() as u32,
            eigenvalues: self.eigenvalues_of_shape(index).to_vec(),
            arrays: ShapeArray::ALL.into_iter().enumerate().filter(is_described).map(describe_array).collect(),
            origin: if shape.is_centered() { shape.origin().to_vec() } else { Vec::new() },
        }
    }

    fn eigenvalues_of_shape(&self, shape: usize) -> &[f64] {
        self.used.first_domains[shape].map_or(&[], |domain| &self.scene.domains[domain as usize].metadata.eigenvalues)
    }

    fn describe_texture(&self, index: usize) -> v1::TextureDescription {
        let texture = &self.scene.textures[index];
        v1::TextureDescription {
            texture: index as u32,
            name: texture.name.clone(),
            width: texture.width(),
            height: texture.height(),
            bytes: texture.rgba().len() as u64,
            sha256: self.hashes.map(|hashes| hashes.of_texture(index).to_vec().into()).unwrap_or_default(),
        }
    }

    fn describe_domain(&self, index: u32) -> v1::DomainDescription {
        let domain = &self.scene.domains[index as usize];
        let attachment = domain.attachment.as_ref();
        let follow_frame = domain.follows.map(|follow| follow.frame);
        let is_attachment_frame = attachment.map(|attachment| attachment.frame) == follow_frame;
        let eigenvalues = &domain.metadata.eigenvalues;
        v1::DomainDescription {
            domain: index,
            name: domain.name.clone(),
            shape: domain.shape as u32,
            material: domain.material as u32,
            material_ranges: domain.material_ranges.iter().map(wire_material_range).collect(),
            placement: transform_bytes(&domain.placement),
            rest_q: domain.rest_q.iter().flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>().into(),
            parent: attachment.map(|attachment| attachment.parent as u32),
            attachment_frame: attachment.map(|attachment| transform_bytes(&attachment.frame)).unwrap_or_default(),
            attachment_vertices: attachment.map(|attachment| attachment.vertices.clone()).unwrap_or_default(),
            follows: domain.follows.map(|follow| follow.parent as u32),
            follow_frame: follow_frame
                .filter(|_| !is_attachment_frame)
                .map(|frame| transform_bytes(&frame))
                .unwrap_or_default(),
            shares_q_with: domain.shares_q_with.map(|other_domain| other_domain as u32),
            eigenvalues: (eigenvalues != self.eigenvalues_of_shape(domain.shape))
                .then(|| v1::Eigenvalues { values: eigenvalues.clone() }),
            notes: domain.metadata.notes.clone().into_iter().collect(),
            exact_placement: exact_placement(domain),
            inertia: domain.metadata.inertia.as_ref().map(wire_inertia),
        }
    }
}

/// The indices below `count` that occur in `indices`, ascending.
fn used_indices(count: usize, indices: impl Iterator<Item = usize>) -> Vec<u32> {
    let mut is_used = vec![false; count];
    indices.for_each(|index| is_used[index] = true);
    (0..count as u32).filter(|index| is_used[*index as usize]).collect()
}

/// Takes as many of the items as fit into `max_bytes` bytes when they are encoded, and at least one.
fn take_fitting<T: prost::Message>(items: impl Iterator<Item = T>, max_bytes: usize) -> Vec<T> {
    let mut total_bytes = 0;
    let mut fitting = Vec::new();
    for item in items {
        // Protobuf adds at most 8 bytes to a nested message: tag and length.
        total_bytes += item.encoded_len() + 8;
        if total_bytes > max_bytes && !fitting.is_empty() {
            break;
        }
        fitting.push(item);
    }
    fitting
}

fn wire_material(index: usize, material: &Material) -> v1::MaterialDescription {
    let (alpha_mode, alpha_cutoff) = match material.alpha_mode {
        AlphaMode::Opaque => (v1::AlphaMode::Opaque, 0.0),
        AlphaMode::Mask { cutoff } => (v1::AlphaMode::Mask, cutoff),
        AlphaMode::Blend => (v1::AlphaMode::Blend, 0.0),
    };
    v1::MaterialDescription {
        material: index as u32,
        name: material.name.clone(),
        ambient: material.ambient.to_vec(),
        diffuse: material.diffuse.to_vec(),
        specular: material.specular.to_vec(),
        shininess: material.shininess,
        alpha: material.alpha,
        alpha_mode: alpha_mode.into(),
        alpha_cutoff,
        double_sided: material.double_sided,
        color_texture: material.color_texture.map(|texture| texture as u32),
        normal_texture: material.normal_texture.map(|texture| texture as u32),
    }
}

const fn wire_material_range(range: &MaterialRange) -> v1::MaterialRange {
    v1::MaterialRange { first_triangle: range.first_triangle as u32, material: range.material as u32 }
}

fn wire_inertia(inertia: &Inertia) -> v1::Inertia {
    v1::Inertia {
        mass: inertia.mass(),
        center: inertia.center().to_vec(),
        moments: inertia.moments().to_vec(),
        modal_momenta: inertia.modal_momenta().to_vec(),
        modal_masses: inertia.modal_masses().to_vec(),
    }
}

/// The placement in f64, row-major 3x4. Empty if `placement` is as exact.
fn exact_placement(domain: &Domain) -> Vec<f64> {
    if domain.placement_remainder == [0.0; 12] {
        return Vec::new();
    }
    let matrix = domain.placement_matrix();
    (0..12).map(|entry| matrix[(entry / 4, entry % 4)]).collect()
}

/// 48 bytes: twelve little-endian f32.
fn transform_bytes(transform: &Transform) -> Bytes {
    transform.0.into_iter().flat_map(f32::to_le_bytes).collect::<Vec<u8>>().into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn message_has_the_items_that_fit_and_at_least_one() {
        let text = |bytes: usize| "x".repeat(bytes);
        let counts = |max_bytes: usize| take_fitting([30, 30, 30].map(text).into_iter(), max_bytes).len();
        assert_eq!([0, 39, 79, 80, 119, 120, 1000].map(counts), [1, 1, 1, 2, 2, 3, 3]);
        assert_eq!(take_fitting(std::iter::empty::<String>(), 100).len(), 0);
    }

    #[test]
    fn wire_inertia_has_every_number_at_its_place() {
        let (moments, momenta, masses) = ([5.0, 6.0, 7.0, 0.1, 0.2, 0.3], vec![0.01; 12], vec![0.5, 0.1, 0.1, 0.7]);
        let inertia = Inertia::new(2.0, [0.1, 0.2, 0.3], moments, momenta.clone(), masses.clone());
        let wire = wire_inertia(&inertia.expect("expected valid masses"));
        assert_eq!((wire.mass, wire.center, wire.moments), (2.0, vec![0.1, 0.2, 0.3], moments.to_vec()));
        assert_eq!((wire.modal_momenta, wire.modal_masses), (momenta, masses));
    }

    #[test]
    fn selection_is_the_list_or_everything() {
        let select = |listed: &[u32]| Selection::new("domains", listed.to_vec(), 4);
        let selected = |listed: &[u32]| select(listed).map(|selection| selection.from(1).collect::<Vec<_>>());
        assert_eq!(selected(&[]).expect("expected all"), [1, 2, 3]);
        assert_eq!(selected(&[3, 0, 3]).expect("expected valid indices"), [0, 3]);
        assert!(select(&[0, 4]).is_err() && select(&[0; 5]).is_err());
    }
}
