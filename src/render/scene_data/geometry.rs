//! Converts the domains of a scene to static arrays: corner indices sorted into draw groups, vertex and texture
//! coordinates of each corner, and material of each triangle.
//!
//! Triangles are grouped by pipeline state (blend mode and sidedness), so that the number of draw calls does not grow
//! with the number of domains. The draw order is the order of the triangles in the groups. A corner is a vertex with
//! one normal and one pair of texture coordinates.

use nalgebra::Vector3;

use modalcast_model::domain::{AlphaMode, Domain, Material};
use modalcast_model::scene::{DomainLayout, Scene};

/// Alpha mode of a material, without its parameters. It determines the pass that draws a triangle.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum BlendMode {
    Opaque,
    /// Cut-outs: fragments with an alpha below the cutoff are discarded.
    Mask,
    Blend,
}

/// A contiguous range of triangles in the draw order that one call draws.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct DrawGroup {
    pub(crate) blend_mode: BlendMode,
    pub(crate) double_sided: bool,
    pub(crate) first_triangle: usize,
    pub(crate) triangle_count: usize,
}

/// A range of triangles that is contiguous both in a mesh and in the draw order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct TriangleSpan {
    /// First triangle, as an index in the draw order.
    pub(crate) first: usize,
    pub(crate) domain: usize,
    /// First triangle, as an index in the domain's mesh.
    pub(crate) triangle: usize,
}

/// Finds a triangle by its index in the draw order. Returns its domain, and its index in the mesh of the domain.
pub(crate) fn locate_triangle(spans: &[TriangleSpan], triangle: usize) -> Option<(usize, usize)> {
    let end = spans.partition_point(|span| span.first <= triangle);
    let span = spans.get(end.checked_sub(1)?)?;
    Some((span.domain, span.triangle + triangle - span.first))
}

/// Static arrays of a scene. Vertices and corners have the order of the scene's layout, triangles the draw order.
#[derive(Debug, Default)]
pub(crate) struct Geometry {
    /// Vertex of each corner, as an index into the positions of the scene.
    pub(crate) corner_vertices: Vec<u32>,
    /// Texture coordinates of each corner; empty if no material has a texture.
    pub(crate) uvs: Vec<[f32; 2]>,
    /// Corner indices of each triangle; they select normals and texture coordinates.
    pub(crate) triangle_corners: Vec<[u32; 3]>,
    /// Vertex indices of each triangle; they select positions.
    pub(crate) triangle_vertices: Vec<[u32; 3]>,
    /// Material of each triangle, as an index in [`used_materials`]; empty if only one material is used.
    pub(crate) triangle_materials: Vec<u32>,
    pub(crate) groups: Vec<DrawGroup>,
    /// Maps the draw order to the meshes of the domains. Sorted by the first triangle.
    pub(crate) spans: Vec<TriangleSpan>,
    /// Index in `groups` of each of the scene's materials.
    group_of_material: Vec<usize>,
}

/// Whether the shaders look up the material of each triangle.
pub(crate) fn uses_material_table(scene: &Scene) -> bool {
    used_materials(scene).len() > 1
}

/// Draw groups of a scene, and the index of each material's group. There are at most six groups, sorted by blend mode.
pub(crate) fn groups(scene: &Scene) -> (Vec<DrawGroup>, Vec<usize>) {
    let mut groups: Vec<DrawGroup> = Vec::new();
    let mut group_of_material = vec![0; scene.materials.len()];
    let mut materials = used_materials(scene);
    materials.sort_by_key(|material| pipeline_key(&scene.materials[*material]));
    for material in materials {
        let (blend_mode, double_sided) = pipeline_key(&scene.materials[material]);
        if groups
            .last()
            .is_none_or(|previous| (previous.blend_mode, previous.double_sided) != (blend_mode, double_sided))
        {
            groups.push(DrawGroup { blend_mode, double_sided, first_triangle: 0, triangle_count: 0 });
        }
        group_of_material[material] = groups.len() - 1;
    }
    for (domain, layout) in scene.domains.iter().zip(&scene.layout.domains) {
        for (material, triangles) in material_triangle_ranges(domain, layout) {
            groups[group_of_material[material]].triangle_count += triangles.len();
        }
    }
    let mut first_triangle = 0;
    for group in &mut groups {
        group.first_triangle = first_triangle;
        first_triangle += group.triangle_count;
    }
    (groups, group_of_material)
}

/// Pipeline state of a material: its blend mode, and whether it is double-sided.
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
        let (groups, group_of_material) = groups(scene);
        let layout = &scene.layout;
        let has_uvs = scene.features.textures || scene.features.normal_maps;
        let mut geometry = Self {
            corner_vertices: Vec::with_capacity(layout.corners),
            uvs: Vec::with_capacity(if has_uvs { layout.corners } else { 0 }),
            triangle_corners: vec![[0; 3]; layout.triangles],
            triangle_vertices: Vec::new(),
            triangle_materials: vec![0; if uses_material_table(scene) { layout.triangles } else { 0 }],
            groups,
            spans: Vec::new(),
            group_of_material,
        };
        let mut material_indices = vec![0; scene.materials.len()];
        for (material_index, material) in (0..).zip(used_materials(scene)) {
            material_indices[material] = material_index;
        }
        // Per group: index in the draw order of the next triangle.
        let mut next_triangles: Vec<usize> = geometry.groups.iter().map(|group| group.first_triangle).collect();
        for (index, domain) in scene.domains.iter().enumerate() {
            geometry.add_corners(scene, domain, &scene.layout.domains[index], has_uvs);
            geometry.add_triangles(scene, index, &material_indices, &mut next_triangles);
        }
        let vertex_of = |corner: u32| geometry.corner_vertices[corner as usize];
        geometry.triangle_vertices = geometry.triangle_corners.iter().map(|corners| corners.map(vertex_of)).collect();
        geometry.spans.sort_unstable_by_key(|span| span.first);
        geometry
    }

    fn add_corners(&mut self, scene: &Scene, domain: &Domain, layout: &DomainLayout, has_uvs: bool) {
        let corners = scene.shapes[domain.shape].mesh.corners();
        self.corner_vertices.extend(corners.vertices.iter().map(|vertex| vertex + layout.first_vertex as u32));
        if has_uvs {
            self.uvs.extend_from_slice(&corners.uvs);
            // All corners of a mesh without texture coordinates sample the same texel.
            self.uvs.resize(self.corner_vertices.len(), [0.0; 2]);
        }
    }

    fn add_triangles(&mut self, scene: &Scene, index: usize, material_indices: &[u32], next_triangles: &mut [usize]) {
        let (domain, layout) = (&scene.domains[index], &scene.layout.domains[index]);
        let mesh = &scene.shapes[domain.shape].mesh;
        let is_mirrored = domain.placement.linear().determinant() < 0.0;
        for (material, range) in material_triangle_ranges(domain, layout) {
            let material_properties = &scene.materials[material];
            let draw_index = &mut next_triangles[self.group_of_material[material]];
            self.spans.push(TriangleSpan { first: *draw_index, domain: index, triangle: range.start });
            for triangle in &mesh.triangles()[range] {
                let is_reversed = is_drawn_reversed(mesh, *triangle, material_properties, is_mirrored);
                let [a, b, c] = triangle.map(|corner| corner + layout.first_corner as u32);
                self.triangle_corners[*draw_index] = if is_reversed { [a, c, b] } else { [a, b, c] };
                if let Some(material_index) = self.triangle_materials.get_mut(*draw_index) {
                    *material_index = material_indices[material];
                }
                *draw_index += 1;
            }
        }
    }
}

/// Material ranges of a domain. Each is a material and the range of its triangles in the domain's mesh.
fn material_triangle_ranges<'a>(
    domain: &'a Domain,
    layout: &DomainLayout,
) -> impl Iterator<Item = (usize, std::ops::Range<usize>)> + 'a {
    let count = layout.triangles;
    let single_range = domain.material_ranges.is_empty().then_some((domain.material, 0..count));
    let range_ends =
        domain.material_ranges.iter().skip(1).map(|material_range| material_range.first_triangle).chain([count]);
    let material_ranges = domain
        .material_ranges
        .iter()
        .zip(range_ends)
        .map(|(material_range, end)| (material_range.material, material_range.first_triangle..end));
    single_range.into_iter().chain(material_ranges)
}

/// Whether a triangle is drawn with its second and third corner exchanged. A mirroring placement reverses the winding
/// of all triangles of its domain. Two reversals cancel each other.
pub(super) fn is_drawn_reversed(
    mesh: &modalcast_model::domain::Mesh,
    triangle: [u32; 3],
    material: &Material,
    is_mirrored: bool,
) -> bool {
    is_mirrored != (material.double_sided && winding_disagrees(mesh, triangle))
}

/// Whether a triangle's winding contradicts its normals. The renderer finds the visible side of a double-sided triangle
/// by the winding, and some files contain triangles with the opposite winding.
fn winding_disagrees(mesh: &modalcast_model::domain::Mesh, triangle: [u32; 3]) -> bool {
    let corners = mesh.corners();
    let position_of =
        |corner: u32| Vector3::from(mesh.rest_positions()[corners.vertices[corner as usize] as usize]).cast::<f64>();
    let normal_of = |corner: u32| Vector3::from(corners.normals[corner as usize]).cast::<f64>();
    let [a, b, c] = triangle;
    let area_vector = (position_of(b) - position_of(a)).cross(&(position_of(c) - position_of(a)));
    area_vector.dot(&(normal_of(a) + normal_of(b) + normal_of(c))) < 0.0
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use modalcast_model::domain::{MaterialRange, Mesh, Modes, Shape, Transform};
    use modalcast_model::scene::SceneParts;

    /// A scene of one unit square (two triangles) per material.
    pub(crate) fn squares(materials: Vec<Material>) -> SceneParts {
        let rest_positions = vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]];
        let uvs = vec![[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]];
        let mesh = Mesh::from_indexed(rest_positions, vec![[0.0, 0.0, 1.0]; 4], uvs, vec![[0, 1, 2], [0, 2, 3]])
            .expect("a square");
        let mut parts = SceneParts::named("squares");
        parts.shapes.push(Shape::new(mesh, Modes::rigid()).expect("rigid"));
        parts.domains = (0..materials.len()).map(|material| domain(material, Transform::IDENTITY)).collect();
        parts.materials = materials;
        parts
    }

    fn domain(material: usize, placement: Transform) -> Domain {
        Domain { material, placement, ..Domain::new(format!("square {material}"), 0) }
    }

    fn material(alpha_mode: AlphaMode, double_sided: bool) -> Material {
        Material { alpha_mode, double_sided, ..Material::default() }
    }

    #[test]
    fn draw_groups_contain_each_triangle_once() {
        let mask = AlphaMode::Mask { cutoff: 0.5 };
        let pattern = [material(AlphaMode::Blend, false), material(AlphaMode::Opaque, true), material(mask, true)];
        let materials: Vec<Material> = (0..300).map(|index| pattern[index % 3].clone()).collect();
        let scene = Scene::new(squares(materials)).expect("a valid scene");
        let geometry = Geometry::new(&scene);
        let blend_modes: Vec<BlendMode> = geometry.groups.iter().map(|group| group.blend_mode).collect();
        assert_eq!(blend_modes, [BlendMode::Opaque, BlendMode::Mask, BlendMode::Blend]);
        assert_eq!(geometry.groups.iter().map(|group| group.triangle_count).sum::<usize>(), 600);
        for group in &geometry.groups {
            for triangle in group.first_triangle..group.first_triangle + group.triangle_count {
                let material = &scene.materials[geometry.triangle_materials[triangle] as usize];
                assert_eq!(pipeline_key(material), (group.blend_mode, group.double_sided));
            }
        }
        // Each square has two triangles and four corners.
        let mut corners = geometry.triangle_corners.as_flattened().to_vec();
        corners.sort_unstable();
        corners.dedup();
        assert_eq!(corners, (0..1200).collect::<Vec<u32>>());
    }

    #[test]
    fn material_ranges_split_a_domain_between_groups() {
        let mut parts = squares(vec![material(AlphaMode::Opaque, false), material(AlphaMode::Blend, false)]);
        parts.domains.truncate(1);
        parts.domains[0].material_ranges =
            vec![MaterialRange { first_triangle: 0, material: 1 }, MaterialRange { first_triangle: 1, material: 0 }];
        let geometry = Geometry::new(&Scene::new(parts).expect("a valid scene"));
        assert_eq!(geometry.triangle_materials, [0, 1]);
        assert_eq!(geometry.triangle_corners, [[0, 2, 3], [0, 1, 2]]);
        // The second triangle is opaque, so it comes first in the draw order.
        let span = |first, triangle| TriangleSpan { first, domain: 0, triangle };
        assert_eq!(geometry.spans, [span(0, 1), span(1, 0)], "expected the spans of both groups");
    }

    #[test]
    fn mirrored_placement_reverses_the_winding() {
        let mut parts = squares(vec![material(AlphaMode::Opaque, false)]);
        // Mirrors x.
        let mut mirroring = Transform::IDENTITY;
        mirroring.0[0] = -1.0;
        parts.domains[0].placement = mirroring;
        let geometry = Geometry::new(&Scene::new(parts).expect("a valid scene"));
        assert_eq!(geometry.triangle_corners, [[0, 2, 1], [0, 3, 2]]);
        assert_eq!(geometry.triangle_vertices, geometry.triangle_corners, "expected one corner per vertex");
        assert!(geometry.triangle_materials.is_empty() && geometry.uvs.is_empty());
    }

    #[test]
    fn only_double_sided_triangles_are_wound_like_their_normals() {
        for (double_sided, expected) in [(true, [0, 2, 1]), (false, [0, 1, 2])] {
            let mut parts = squares(vec![material(AlphaMode::Opaque, double_sided)]);
            let rest_positions = parts.shapes[0].mesh.rest_positions().to_vec();
            // The winding of the triangle gives +z, its normals are -z.
            let mesh = Mesh::from_indexed(rest_positions, vec![[0.0, 0.0, -1.0]; 4], vec![], vec![[0, 1, 2]])
                .expect("a triangle");
            parts.shapes[0] = Shape::new(mesh, Modes::rigid()).expect("rigid");
            let geometry = Geometry::new(&Scene::new(parts).expect("a valid scene"));
            assert_eq!(geometry.triangle_corners, [expected]);
        }
    }
}
