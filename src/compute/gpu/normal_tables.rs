//! Tables of `normals`, derived from a scene: slots, blocks, rest normals and tangents. Pure.

use super::layout::{BLOCK, NO_TANGENTS};
use modalcast_model::scene::Scene;

/// Offsets of the corners of one domain. Instances share `first_normal` and `first_tangent`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct CornerSlot {
    pub first: u32,
    pub first_normal: u32,
    pub first_tangent: u32,
}

/// One slot per domain.
pub(super) fn corner_slots(scene: &Scene) -> Vec<CornerSlot> {
    let (mut normals, mut tangents) = (0, 0);
    let mut places = Vec::with_capacity(scene.shapes.len());
    for shape in &scene.shapes {
        places.push((normals, if shape.tangents().is_empty() { NO_TANGENTS } else { tangents }));
        normals += shape.mesh.corners().vertices.len() as u32;
        tangents += shape.tangents().len() as u32;
    }
    let slot = |(domain, slot): (&modalcast_model::domain::Domain, &modalcast_model::scene::DomainLayout)| {
        let (first_normal, first_tangent) = places[domain.shape];
        CornerSlot { first: slot.first_corner as u32, first_normal, first_tangent }
    };
    scene.domains.iter().zip(&scene.layout.slots).map(slot).collect()
}

/// The domain of the first item of each block, followed by the last domain. `firsts`: the first items of all domains in
/// order. `items`: the number of items.
pub(super) fn first_domains(firsts: impl Iterator<Item = u32>, items: usize) -> Vec<u32> {
    let mut blocks: Vec<u32> = Vec::with_capacity(items.div_ceil(BLOCK as usize) + 1);
    let mut last = 0;
    for (domain, first) in firsts.enumerate() {
        // All blocks that begin before this domain's first item begin in the previous domain.
        while (blocks.len() as u64) * u64::from(BLOCK) < u64::from(first) {
            blocks.push(last);
        }
        last = domain as u32;
    }
    while blocks.len() * (BLOCK as usize) < items {
        blocks.push(last);
    }
    blocks.push(last);
    blocks
}

/// Rest normals of all shapes, one plane per axis.
pub(super) fn rest_normals(scene: &Scene) -> Vec<f32> {
    let all = |axis: usize| {
        scene.shapes.iter().flat_map(move |shape| shape.mesh.corners().normals.iter().map(move |normal| normal[axis]))
    };
    (0..3).flat_map(all).collect()
}

/// Number of corners of all shapes: the length of one plane of [`rest_normals`].
pub(super) fn rest_corners(scene: &Scene) -> usize {
    scene.shapes.iter().map(|shape| shape.mesh.corners().vertices.len()).sum()
}

/// Tangents of all shapes that have tangents.
pub(super) fn rest_tangents(scene: &Scene) -> Vec<[f32; 4]> {
    scene.shapes.iter().flat_map(|shape| shape.tangents()).copied().collect()
}

/// The length of [`rest_tangents`].
pub(super) fn tangent_count(scene: &Scene) -> usize {
    scene.shapes.iter().map(|shape| shape.tangents().len()).sum()
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use modalcast_model::domain::{
        Attachment, Corners, Domain, FollowConstraint, Material, Mesh, Metadata, Modes, Shape, Texture, Transform,
    };
    use modalcast_model::scene::{DeformationSettings, NormalMethod, SceneParts, StorageType};
    use std::sync::Arc;

    fn shape(vertices: usize, rank: usize) -> Shape {
        let rest = (0..vertices).map(|vertex| [vertex as f32, 0.5, -1.0]).collect();
        let count = vertices + 2;
        let corners = Corners {
            vertices: (0..count).map(|corner| (corner % vertices) as u32).collect(),
            normals: (0..count).map(|corner| [1.0, corner as f32, 0.0]).collect(),
            uvs: vec![[0.0, 1.0]; count],
        };
        let mesh = Mesh::new(rest, corners, vec![[0, 1, 2]]).expect("a mesh");
        let entries = (0..3 * vertices * rank).map(|entry| 0.25 * entry as f32).collect();
        Shape::new(mesh, Modes::from_columns(3 * vertices, rank, entries).expect("modes")).expect("a shape")
    }

    fn domain(shape: usize, material: usize) -> Domain {
        Domain {
            name: String::new(),
            shape,
            material,
            placement: Transform::IDENTITY,
            attachment: None::<Attachment>,
            follows: None,
            material_ranges: vec![],
            rest_q: Vec::new(),
            shares_q_with: None,
            metadata: Metadata::default(),
        }
    }

    /// A scene whose shapes have these vertices and ranks, each used by two domains.
    pub(in super::super) fn scene(shapes: &[(usize, usize)], normal_maps: bool, rigid: bool) -> Arc<Scene> {
        Scene::new(parts(shapes, normal_maps, rigid)).expect("a scene")
    }

    /// Such a scene without normal maps; all domains follow the first one.
    pub(in super::super) fn on_the_first(shapes: &[(usize, usize)]) -> Arc<Scene> {
        followed(shapes, DeformationSettings::default())
    }

    /// Such a scene with these deformation settings.
    pub(in super::super) fn followed(shapes: &[(usize, usize)], deformation: DeformationSettings) -> Arc<Scene> {
        let mut parts = parts(shapes, false, true);
        parts.deformation = deformation;
        let follow = FollowConstraint { parent: 0, frame: Transform::IDENTITY };
        parts.domains.iter_mut().skip(1).for_each(|domain| domain.follows = Some(follow));
        Scene::new(parts).expect("a scene")
    }

    /// A scene without normal maps, with this storage of U.
    pub(in super::super) fn stored(shapes: &[(usize, usize)], storage: StorageType) -> Arc<Scene> {
        let mut parts = parts(shapes, false, false);
        parts.deformation.storage = storage;
        Scene::new(parts).expect("a scene")
    }

    /// A scene without normal maps, with these deformation settings.
    pub(in super::super) fn deformed(shapes: &[(usize, usize)], deformation: DeformationSettings) -> Arc<Scene> {
        let mut parts = parts(shapes, false, false);
        parts.deformation = deformation;
        Scene::new(parts).expect("a scene")
    }

    /// A scene without normal maps, with exact normals.
    pub(in super::super) fn exact(shapes: &[(usize, usize)]) -> Arc<Scene> {
        let mut parts = parts(shapes, false, false);
        parts.deformation.normals = NormalMethod::Exact;
        Scene::new(parts).expect("a scene")
    }

    /// A scene without normal maps, with displacements and boxes.
    pub(in super::super) fn kept(shapes: &[(usize, usize)]) -> Arc<Scene> {
        let mut parts = parts(shapes, false, false);
        (parts.deformation.displacements, parts.deformation.boxes) = (true, true);
        Scene::new(parts).expect("a scene")
    }

    /// A scene without normal maps and without a shadow.
    pub(in super::super) fn unlit(shapes: &[(usize, usize)]) -> Arc<Scene> {
        let mut parts = parts(shapes, false, false);
        parts.look.shadow = None;
        Scene::new(parts).expect("a scene")
    }

    /// Every shape used by two domains; corner i is vertex i.
    pub(in super::super) fn corners_match(shapes: &[(usize, usize)]) -> Arc<Scene> {
        let mut parts = parts(shapes, false, false);
        for shape in &mut parts.shapes {
            let (rest, corners) = (shape.mesh.rest().to_vec(), shape.mesh.corners().clone());
            let (normals, uvs) = (corners.normals[..rest.len()].to_vec(), corners.uvs[..rest.len()].to_vec());
            let mesh = Mesh::from_indexed(rest, normals, uvs, vec![[0, 1, 2]]).expect("a mesh");
            *shape = Shape::new(mesh, shape.modes.clone()).expect("a shape");
        }
        Scene::new(parts).expect("a scene")
    }

    /// Every shape used by one domain.
    pub(in super::super) fn used_once(shapes: &[(usize, usize)]) -> Arc<Scene> {
        let mut parts = parts(shapes, false, false);
        parts.domains = (0..shapes.len()).map(|index| domain(index, 0)).collect();
        Scene::new(parts).expect("a scene")
    }

    fn parts(shapes: &[(usize, usize)], normal_maps: bool, rigid: bool) -> SceneParts {
        let mut parts = SceneParts::named("test");
        parts.rigid_transforms = rigid;
        parts.shapes = shapes.iter().map(|(vertices, rank)| shape(*vertices, *rank)).collect();
        let mapped = Material { normal_texture: normal_maps.then_some(0), ..Material::default() };
        parts.materials = vec![Material::default(), mapped];
        parts.textures = vec![Texture::new("flat", 1, 1, vec![128, 128, 255, 255]).expect("a texture")];
        let last = shapes.len() - 1;
        parts.domains = (0..2 * shapes.len()).map(|index| domain(index / 2, usize::from(index / 2 == last))).collect();
        parts
    }

    const SHAPES: [(usize, usize); 4] = [(7, 2), (300, 0), (8, 5), (513, 1)];

    #[test]
    fn instances_share_normals_but_not_corners() {
        let scene = scene(&SHAPES, true, false);
        let corners = corner_slots(&scene);
        assert_eq!(corners[0].first_normal, corners[1].first_normal);
        assert_ne!(corners[0].first, corners[1].first);
        assert_eq!(corners[0].first_tangent, NO_TANGENTS, "only the last shape has a normal map");
        assert_eq!((corners[6].first_tangent, corners[7].first_tangent), (0, 0));
        let normals = rest_normals(&scene);
        let plane = rest_corners(&scene);
        for (domain, slot) in corners.iter().enumerate() {
            for (corner, normal) in scene.shape_of(domain).mesh.corners().normals.iter().enumerate() {
                let at = |axis: usize| normals[axis * plane + slot.first_normal as usize + corner];
                assert_eq!([at(0), at(1), at(2)], *normal);
            }
        }
    }

    #[test]
    fn the_first_domain_of_each_block_brackets_the_domains_of_all_its_corners() {
        let sizes: [&[u32]; 5] = [&[1], &[256], &[255, 1, 1], &[7; 1000], &[1000, 3, 256, 512, 1, 700]];
        for sizes in sizes {
            let firsts: Vec<u32> =
                sizes.iter().scan(0, |sum, size| Some(std::mem::replace(sum, *sum + size))).collect();
            let items: u32 = sizes.iter().sum();
            let blocks = first_domains(firsts.iter().copied(), items as usize);
            assert_eq!(blocks.len(), items.div_ceil(BLOCK) as usize + 1);
            for item in 0..items {
                let domain = firsts.partition_point(|first| *first <= item) as u32 - 1;
                let block = (item / BLOCK) as usize;
                assert!((blocks[block]..=blocks[block + 1]).contains(&domain), "item {item} of {sizes:?}");
                if item % BLOCK == 0 {
                    assert_eq!(blocks[block], domain);
                }
            }
        }
    }
}
