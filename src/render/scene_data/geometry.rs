//! Converts a scene's domains to the static arrays: corner indices sorted into draw groups, vertex and texture
//! coordinates of each corner, and the material of each triangle.
//!
//! Triangles are grouped by pipeline state, so that the number of draw calls does not grow with the number of domains.

use nalgebra::Vector3;

use modalcast_model::domain::{AlphaMode, Domain, Material};
use modalcast_model::scene::{DomainLayout, Scene};

/// The pass that draws a triangle, from its material's alpha mode.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum BlendMode {
    Opaque,
    Mask,
    Blend,
}

/// A contiguous range of triangles that one call draws.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct DrawGroup {
    pub(crate) blend_mode: BlendMode,
    pub(crate) double_sided: bool,
    pub(crate) first_triangle: usize,
    pub(crate) triangles: usize,
}

/// A range of triangles that is contiguous both in a mesh and in the draw order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct TriangleSpan {
    /// Its first triangle in the draw order.
    pub(crate) first: usize,
    pub(crate) domain: usize,
    /// The same triangle in the domain's mesh.
    pub(crate) triangle: usize,
}

/// Domain of a triangle, and its index in the domain's mesh; `place` is the triangle's index in the draw order.
pub(crate) fn locate_triangle(spans: &[TriangleSpan], place: usize) -> Option<(usize, usize)> {
    let after = spans.partition_point(|stretch| stretch.first <= place);
    let stretch = spans.get(after.checked_sub(1)?)?;
    Some((stretch.domain, stretch.triangle + place - stretch.first))
}

/// The static arrays, packed as the scene's layout says; triangles are in draw order.
#[derive(Debug, Default)]
pub(crate) struct Geometry {
    /// Per corner: its vertex in the packed positions.
    pub(crate) vertices: Vec<u32>,
    /// Per corner; empty when nothing samples a texture.
    pub(crate) uvs: Vec<[f32; 2]>,
    /// Per triangle: three corners in the packed normals.
    pub(crate) triangles: Vec<[u32; 3]>,
    /// Per triangle: the vertices of its corners.
    pub(crate) triangle_vertices: Vec<[u32; 3]>,
    /// Per triangle: index of its material among the used ones; empty when all triangles have the same material.
    pub(crate) materials: Vec<u32>,
    pub(crate) groups: Vec<DrawGroup>,
    /// Sorted by the first triangle.
    pub(crate) spans: Vec<TriangleSpan>,
    /// Group of each material.
    group_of: Vec<usize>,
}

/// Whether the shaders look up the material of each triangle.
pub(crate) fn uses_material_table(scene: &Scene) -> bool {
    used_materials(scene).len() > 1
}

/// The groups of a scene, opaque, then mask, then blend, six at most; and the group of each material.
pub(crate) fn groups(scene: &Scene) -> (Vec<DrawGroup>, Vec<usize>) {
    let mut groups: Vec<DrawGroup> = Vec::new();
    let mut of_material = vec![0; scene.materials.len()];
    let mut used = used_materials(scene);
    used.sort_by_key(|material| pipeline_key(&scene.materials[*material]));
    for material in used {
        let (blend_mode, double_sided) = pipeline_key(&scene.materials[material]);
        if groups.last().is_none_or(|last| (last.blend_mode, last.double_sided) != (blend_mode, double_sided)) {
            groups.push(DrawGroup { blend_mode, double_sided, first_triangle: 0, triangles: 0 });
        }
        of_material[material] = groups.len() - 1;
    }
    for (domain, slot) in scene.domains.iter().zip(&scene.layout.domains) {
        for (material, triangles) in spans(domain, slot) {
            groups[of_material[material]].triangles += triangles.len();
        }
    }
    let mut first_triangle = 0;
    for group in &mut groups {
        group.first_triangle = first_triangle;
        first_triangle += group.triangles;
    }
    (groups, of_material)
}

/// Pipeline state of a material.
fn pipeline_key(material: &Material) -> (BlendMode, bool) {
    (blend_mode(material), material.double_sided)
}

pub(crate) const fn blend_mode(material: &Material) -> BlendMode {
    match material.alpha_mode {
        AlphaMode::Opaque => BlendMode::Opaque,
        AlphaMode::Mask { .. } => BlendMode::Mask,
        AlphaMode::Blend => BlendMode::Blend,
    }
}

/// Indices of the materials that triangles use, ascending.
pub(crate) fn used_materials(scene: &Scene) -> Vec<usize> {
    let used: std::collections::BTreeSet<usize> = scene.domains.iter().flat_map(Domain::materials).collect();
    used.into_iter().collect()
}

impl Geometry {
    pub(crate) fn new(scene: &Scene) -> Self {
        let (groups, group_of) = groups(scene);
        let layout = &scene.layout;
        let textured = scene.features.textures || scene.features.normal_maps;
        let mut geometry = Self {
            vertices: Vec::with_capacity(layout.corners),
            uvs: Vec::with_capacity(if textured { layout.corners } else { 0 }),
            triangles: vec![[0; 3]; layout.triangles],
            triangle_vertices: Vec::new(),
            materials: vec![0; if uses_material_table(scene) { layout.triangles } else { 0 }],
            groups,
            spans: Vec::new(),
            group_of,
        };
        let mut rank = vec![0; scene.materials.len()];
        for (place, material) in (0..).zip(used_materials(scene)) {
            rank[material] = place;
        }
        let mut next: Vec<usize> = geometry.groups.iter().map(|group| group.first_triangle).collect();
        for (index, domain) in scene.domains.iter().enumerate() {
            geometry.add_corners(scene, domain, &scene.layout.domains[index], textured);
            geometry.add_triangles(scene, index, &rank, &mut next);
        }
        let vertex = |corner: u32| geometry.vertices[corner as usize];
        geometry.triangle_vertices = geometry.triangles.iter().map(|corners| corners.map(vertex)).collect();
        geometry.spans.sort_unstable_by_key(|stretch| stretch.first);
        geometry
    }

    fn add_corners(&mut self, scene: &Scene, domain: &Domain, slot: &DomainLayout, textured: bool) {
        let corners = scene.shapes[domain.shape].mesh.corners();
        self.vertices.extend(corners.vertices.iter().map(|vertex| vertex + slot.first_vertex as u32));
        if textured {
            self.uvs.extend_from_slice(&corners.uvs);
            // A mesh without texture coordinates samples one texel everywhere.
            self.uvs.resize(self.vertices.len(), [0.0; 2]);
        }
    }

    fn add_triangles(&mut self, scene: &Scene, index: usize, rank: &[u32], next: &mut [usize]) {
        let (domain, slot) = (&scene.domains[index], &scene.layout.domains[index]);
        let mesh = &scene.shapes[domain.shape].mesh;
        // A mirroring placement reverses the winding of all triangles.
        let mirrored = domain.placement.linear().determinant() < 0.0;
        for (material, range) in spans(domain, slot) {
            let blend_mode = &scene.materials[material];
            let place = &mut next[self.group_of[material]];
            self.spans.push(TriangleSpan { first: *place, domain: index, triangle: range.start });
            for triangle in &mesh.triangles()[range] {
                let disagrees = blend_mode.double_sided && winding_disagrees(mesh, *triangle);
                let [a, b, c] = triangle.map(|corner| corner + slot.first_corner as u32);
                self.triangles[*place] = if mirrored == disagrees { [a, b, c] } else { [a, c, b] };
                if let Some(slot) = self.materials.get_mut(*place) {
                    *slot = rank[material];
                }
                *place += 1;
            }
        }
    }
}

/// The material runs of a domain, as ranges of its triangles.
fn spans<'a>(domain: &'a Domain, slot: &DomainLayout) -> impl Iterator<Item = (usize, std::ops::Range<usize>)> + 'a {
    let count = slot.triangles;
    let whole = domain.material_ranges.is_empty().then_some((domain.material, 0..count));
    let ends = domain.material_ranges.iter().skip(1).map(|run| run.first_triangle).chain([count]);
    let material_ranges =
        domain.material_ranges.iter().zip(ends).map(|(run, end)| (run.material, run.first_triangle..end));
    whole.into_iter().chain(material_ranges)
}

/// Whether a triangle's winding contradicts its normals. The winding decides which side of a double-sided triangle is
/// visible, so it must agree with the normals; not all files guarantee that.
fn winding_disagrees(mesh: &modalcast_model::domain::Mesh, triangle: [u32; 3]) -> bool {
    let corners = mesh.corners();
    let at =
        |corner: u32| Vector3::from(mesh.rest_positions()[corners.vertices[corner as usize] as usize]).cast::<f64>();
    let normal = |corner: u32| Vector3::from(corners.normals[corner as usize]).cast::<f64>();
    let [a, b, c] = triangle;
    let area = (at(b) - at(a)).cross(&(at(c) - at(a)));
    area.dot(&(normal(a) + normal(b) + normal(c))) < 0.0
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use modalcast_model::domain::{MaterialRange, Mesh, Modes, Shape, Transform};
    use modalcast_model::scene::SceneParts;

    /// A scene of one unit square (two triangles) per material.
    pub(crate) fn squares(materials: Vec<Material>) -> SceneParts {
        let rest = vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]];
        let uvs = vec![[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]];
        let mesh =
            Mesh::from_indexed(rest, vec![[0.0, 0.0, 1.0]; 4], uvs, vec![[0, 1, 2], [0, 2, 3]]).expect("a square");
        let mut parts = SceneParts::named("squares");
        parts.shapes.push(Shape::new(mesh, Modes::rigid()).expect("rigid"));
        parts.domains = (0..materials.len()).map(|material| domain(material, Transform::IDENTITY)).collect();
        parts.materials = materials;
        parts
    }

    fn domain(material: usize, placement: Transform) -> Domain {
        Domain { material, placement, ..Domain::new(format!("square {material}"), 0) }
    }

    fn of(alpha_mode: AlphaMode, double_sided: bool) -> Material {
        Material { alpha_mode, double_sided, ..Material::default() }
    }

    #[test]
    fn draw_groups_do_not_grow_with_domains_or_materials_and_keep_every_triangle() {
        let mask = AlphaMode::Mask { cutoff: 0.5 };
        let pattern = [of(AlphaMode::Blend, false), of(AlphaMode::Opaque, true), of(mask, true)];
        let materials: Vec<Material> = (0..300).map(|index| pattern[index % 3].clone()).collect();
        let scene = Scene::new(squares(materials)).expect("good");
        let geometry = Geometry::new(&scene);
        let kinds: Vec<BlendMode> = geometry.groups.iter().map(|group| group.blend_mode).collect();
        assert_eq!(kinds, [BlendMode::Opaque, BlendMode::Mask, BlendMode::Blend]);
        assert_eq!(geometry.groups.iter().map(|group| group.triangles).sum::<usize>(), 600);
        for group in &geometry.groups {
            for triangle in group.first_triangle..group.first_triangle + group.triangles {
                let material = &scene.materials[geometry.materials[triangle] as usize];
                assert_eq!(pipeline_key(material), (group.blend_mode, group.double_sided));
            }
        }
        let mut seen = geometry.triangles.as_flattened().to_vec();
        seen.sort_unstable();
        seen.dedup();
        assert_eq!(seen, (0..1200).collect::<Vec<u32>>());
    }

    #[test]
    fn runs_split_a_domain_between_groups() {
        let mut parts = squares(vec![of(AlphaMode::Opaque, false), of(AlphaMode::Blend, false)]);
        parts.domains.truncate(1);
        parts.domains[0].material_ranges =
            vec![MaterialRange { first_triangle: 0, material: 1 }, MaterialRange { first_triangle: 1, material: 0 }];
        let geometry = Geometry::new(&Scene::new(parts).expect("good"));
        assert_eq!(geometry.materials, [0, 1]);
        assert_eq!(geometry.triangles, [[0, 2, 3], [0, 1, 2]]);
        let stretch = |first, triangle| TriangleSpan { first, domain: 0, triangle };
        assert_eq!(geometry.spans, [stretch(0, 1), stretch(1, 0)], "where each came from");
    }

    #[test]
    fn a_mirrored_placement_turns_the_winding_and_one_material_needs_no_list() {
        let mut parts = squares(vec![of(AlphaMode::Opaque, false)]);
        let mut mirror = Transform::IDENTITY;
        mirror.0[0] = -1.0;
        parts.domains[0].placement = mirror;
        let geometry = Geometry::new(&Scene::new(parts).expect("good"));
        assert_eq!(geometry.triangles, [[0, 2, 1], [0, 3, 2]]);
        assert_eq!(geometry.triangle_vertices, geometry.triangles, "here a corner is a vertex");
        assert!(geometry.materials.is_empty() && geometry.uvs.is_empty());
    }

    #[test]
    fn a_double_sided_triangle_wound_against_its_normals_is_turned_and_a_single_sided_one_is_kept() {
        for (double_sided, expected) in [(true, [0, 2, 1]), (false, [0, 1, 2])] {
            let mut parts = squares(vec![of(AlphaMode::Opaque, double_sided)]);
            let rest = parts.shapes[0].mesh.rest_positions().to_vec();
            let mesh = Mesh::from_indexed(rest, vec![[0.0, 0.0, -1.0]; 4], vec![], vec![[0, 1, 2]]).expect("good");
            parts.shapes[0] = Shape::new(mesh, Modes::rigid()).expect("rigid");
            let geometry = Geometry::new(&Scene::new(parts).expect("good"));
            assert_eq!(geometry.triangles, [expected]);
        }
    }
}
