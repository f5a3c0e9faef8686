//! Tests of packing.

use super::*;
use crate::engine::device::handle::PendingReply;
use crate::engine::testing;

const STEP: StepId = StepId { run: 1, number: 4, time: 0.0 };

/// `count` consecutive numbers.
fn numbers_from(first: f32, count: usize) -> Vec<f32> {
    (0..count).map(|index| first + index as f32).collect()
}

fn output(vertices: &Arc<StepVertices>) -> StepOutput {
    let body = OutputBody::Vertices(Arc::new(PendingReply::answered(Arc::clone(vertices))));
    StepOutput { step: STEP, skipped: 0, stages: vec![], origins: None, body }
}

fn select(scene: &Arc<Scene>, domains: Vec<u32>, attributes: &[(Attribute, Encoding)]) -> Arc<VertexSelection> {
    Arc::new(VertexSelection::new(scene, domains, attributes.to_vec()).expect("expected a valid selection"))
}

/// Packs without origins.
async fn pack(vertices: &Arc<StepVertices>, selection: &Arc<VertexSelection>) -> PackedVertices {
    let packer = VertexPacker::start().expect("expected threads");
    let known_origins: Origins = Arc::new([selection.scene.origin]);
    packer.pack(output(vertices), selection, Some(known_origins)).await.expect("expected packed vertices")
}

async fn packed_floats(vertices: &Arc<StepVertices>, selection: &Arc<VertexSelection>) -> Vec<f32> {
    bytemuck::pod_collect_to_vec(&pack(vertices, selection).await.parts.concat())
}

fn step_vertices(surface: DeformedSurface) -> Arc<StepVertices> {
    Arc::new(StepVertices::new(Arc::new(surface), 0.0))
}

const F32_POSITIONS: (Attribute, Encoding) = (Attribute::Positions, Encoding::F32);
const F32_NORMALS: (Attribute, Encoding) = (Attribute::Normals, Encoding::F32);

#[tokio::test]
async fn packs_attributes_in_the_selected_order() {
    let scene = testing::two_strips();
    let surface = DeformedSurface {
        positions: numbers_from(0.0, 24),
        normals: numbers_from(100.0, 24),
        ..DeformedSurface::default()
    };
    let positions = surface.positions.clone();
    let vertices = step_vertices(surface);
    // Each strip has four vertices and four corners. Numbers 12 to 23 of each list belong to the second strip.
    let expected = [numbers_from(12.0, 12), numbers_from(112.0, 12)].concat();
    assert_eq!(packed_floats(&vertices, &select(&scene, vec![1], &[])).await, expected);
    let selection = select(&scene, vec![1, 0], &[F32_NORMALS, F32_POSITIONS]);
    let second_then_first = |first: f32| [numbers_from(first + 12.0, 12), numbers_from(first, 12)].concat();
    let expected = [second_then_first(100.0), second_then_first(0.0)].concat();
    assert_eq!(packed_floats(&vertices, &selection).await, expected);
    assert_eq!(packed_floats(&vertices, &select(&scene, vec![], &[F32_POSITIONS])).await, positions);
}

#[tokio::test]
async fn f32_parts_refer_to_the_vertices_themselves() {
    let scene = testing::two_strips();
    let vertices = step_vertices(DeformedSurface { positions: numbers_from(0.0, 24), ..DeformedSurface::default() });
    let part_address =
        async |domains: Vec<u32>| pack(&vertices, &select(&scene, domains, &[F32_POSITIONS])).await.parts[0].as_ptr();
    let numbers = &vertices.surface.positions;
    assert_eq!(part_address(vec![]).await, numbers.as_ptr().cast());
    assert_eq!(part_address(vec![1]).await, numbers[12..].as_ptr().cast());
    // Control: small ranges that are not consecutive are copied together.
    let range = numbers.as_ptr_range();
    let copied = part_address(vec![1, 0]).await.cast();
    assert!(!range.contains(&copied));
}

#[tokio::test]
async fn vertices_stay_in_memory_until_their_parts_are_dropped() {
    let vertices = step_vertices(DeformedSurface { positions: numbers_from(0.0, 24), ..DeformedSurface::default() });
    let surface = Arc::clone(&vertices.surface);
    let packed = pack(&vertices, &select(&testing::two_strips(), vec![], &[F32_POSITIONS])).await;
    drop(vertices);
    assert_eq!(Arc::strong_count(&surface), 2);
    drop(packed);
    assert_eq!(Arc::strong_count(&surface), 1);
}

#[tokio::test]
async fn readers_of_equal_sections_share_their_bytes() {
    let scene = testing::two_strips();
    let surface = || DeformedSurface {
        positions: numbers_from(0.0, 24),
        normals: [0.0, 0.0, 1.0].repeat(8),
        ..DeformedSurface::default()
    };
    let vertices = step_vertices(surface());
    let compact = [(Attribute::Positions, Encoding::U16Box), (Attribute::Normals, Encoding::OctahedralI16)];
    let all = pack(&vertices, &select(&scene, vec![], &compact)).await;
    let normals = pack(&vertices, &select(&scene, vec![0, 1], &compact[1..])).await;
    assert_eq!(all.parts[2].as_ptr(), normals.parts[0].as_ptr(), "expected shared normals");
    // Controls: other domains, another encoding, and another step.
    let second_domain = pack(&vertices, &select(&scene, vec![1], &compact[1..])).await;
    assert_eq!(second_domain.parts[0].len(), 16);
    let f16 = pack(&vertices, &select(&scene, vec![], &[(Attribute::Normals, Encoding::F16)])).await;
    assert_eq!(f16.parts[0].len(), 48);
    let next_step = pack(&step_vertices(surface()), &select(&scene, vec![], &compact)).await;
    assert_eq!(next_step.parts, all.parts);
    assert_ne!(next_step.parts[2].as_ptr(), all.parts[2].as_ptr());
}

#[tokio::test]
async fn sections_cover_the_bytes_without_gaps() {
    let scene = testing::strips_with_attributes();
    let vertices = step_vertices(DeformedSurface {
        positions: numbers_from(0.0, 24),
        normals: [0.0, 0.0, 1.0].repeat(8),
        displacements: numbers_from(50.0, 24),
        boxes: vec![BoundingBox { min: [-1.0; 3], max: [2.0; 3] }; 2],
        ..DeformedSurface::default()
    });
    let attributes = [
        (Attribute::Positions, Encoding::U16Box),
        (Attribute::Normals, Encoding::OctahedralI16),
        (Attribute::Displacements, Encoding::F16),
        (Attribute::Boxes, Encoding::F32),
    ];
    let selection = select(&scene, vec![0], &attributes);
    let packer = VertexPacker::start().expect("expected threads");
    let other_origins: Origins = Arc::new([[1e7, 0.0, -3.0]]);
    let packed = packer.pack(output(&vertices), &selection, Some(other_origins)).await;
    let packed = packed.expect("expected packed vertices");
    let names: Vec<_> = packed.sections.iter().map(|section| (section.attribute, section.encoding)).collect();
    assert_eq!(names, [&attributes[..], &[(Attribute::Origins, Encoding::F64)]].concat());
    // Four vectors each: a box and 6 bytes a vector, 4 bytes, 6 bytes; then one box and one origin.
    assert_eq!(packed.sections.iter().map(|section| section.bytes).collect::<Vec<_>>(), [24 + 24, 16, 24, 24, 24]);
    let mut end = 0;
    for section in &packed.sections {
        assert_eq!(section.offset, end);
        end += section.bytes;
    }
    let bytes = packed.parts.concat();
    assert_eq!((end, packed.total_bytes()), (bytes.len() as u64, bytes.len() as u64));
    assert_eq!(bytemuck::pod_collect_to_vec::<u8, f64>(&bytes[bytes.len() - 24..]), scene.origin);
    let boxes = bytemuck::pod_collect_to_vec::<u8, f32>(&bytes[88..112]);
    assert_eq!(boxes, [-1.0, -1.0, -1.0, 2.0, 2.0, 2.0]);
}

#[tokio::test]
async fn missing_attributes_are_a_fault() {
    let scene = testing::strips_with_attributes();
    let vertices = step_vertices(DeformedSurface { positions: numbers_from(0.0, 12), ..DeformedSurface::default() });
    let packer = VertexPacker::start().expect("expected threads");
    let attributes =
        [F32_POSITIONS, (Attribute::Positions, Encoding::U16Box), F32_NORMALS, (Attribute::Boxes, Encoding::F32)];
    for (attribute, encoding) in attributes {
        let selection = select(&scene, vec![], &[(attribute, encoding)]);
        let error = packer.pack(output(&vertices), &selection, None).await.expect_err("expected a fault");
        assert!(error.to_string().contains("expected"), "{attribute:?} as {encoding:?}: {error}");
    }
    // Control: the first domain is complete.
    let selection = select(&scene, vec![0], &[F32_POSITIONS]);
    assert!(packer.pack(output(&vertices), &selection, None).await.is_ok());
    let panicked: Result<()> = packer.run(|| panic!("intended panic")).await;
    assert!(panicked.expect_err("expected a fault").to_string().contains("panicked"));
}
