//! Domains that share a shape, in groups for which `batch` reads U once. Pure.

use super::super::layout::{Block, Group, Member};
use super::{Coordinates, Work, chunks_of, quads_of};
use crate::scene::{Batches, Scene};
use crate::storage::TILE_QUADS;

/// The most domains of a group.
pub(in super::super) const MOST: usize = 16;

/// In scenes that choose, a shape has batches from so many domains on,
const LEAST_USERS: usize = 3;
/// and so many tiles of all of them: fewer would leave multiprocessors without work.
const LEAST_TILES: usize = 1024;

/// What `batch` computes of a scene.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(in super::super) struct Batched {
    pub groups: Vec<Group>,
    pub members: Vec<Member>,
    pub blocks: Vec<Block>,
    /// The most chunks of modes of a group.
    pub chunks: usize,
    /// The most members of a group.
    pub most: usize,
}

/// Of each shape, whether its domains are deformed together.
pub(in super::super) fn shapes(scene: &Scene) -> Vec<bool> {
    let needs = scene.needs;
    // They sum in other ways, or write more.
    let never = needs.truncation || needs.compensated || needs.displacements;
    let mut users = vec![0_usize; scene.shapes.len()];
    scene.domains.iter().for_each(|domain| users[domain.shape] += 1);
    let chosen = |(shape, users): (usize, usize)| {
        let tiles = users * quads_of(&scene.shapes[shape]).div_ceil(TILE_QUADS);
        match scene.deformation.batches {
            Batches::Never => false,
            Batches::Auto => users >= LEAST_USERS && tiles >= LEAST_TILES,
            Batches::Always => users > 1,
        }
    };
    let has_modes = |shape: usize| scene.shapes[shape].modes.rank() > 0;
    users.into_iter().enumerate().map(|user| !never && has_modes(user.0) && chosen(user)).collect()
}

impl Batched {
    /// Of the tiles that are there; `first_words` are those of the shapes.
    pub(super) fn new(
        scene: &Scene,
        (work, coordinates): (&Work, &Coordinates),
        (batched, first_words): (&[bool], &[Option<u64>]),
    ) -> Self {
        let mut shapes: Vec<usize> = (0..scene.shapes.len()).filter(|shape| batched[*shape]).collect();
        shapes.sort_by_key(|shape| std::cmp::Reverse(chunks_of(scene, &scene.shapes[*shape])));
        let mut users = vec![Vec::new(); scene.shapes.len()];
        scene.domains.iter().enumerate().for_each(|(index, domain)| users[domain.shape].push(index));
        let mut all = Self::default();
        for shape in shapes {
            let of = &scene.shapes[shape];
            let first_group = all.groups.len();
            let users = &users[shape];
            // Groups of the same size: none of them is nearly empty.
            let count = users.len().div_ceil(MOST);
            for list in users.chunks(users.len().div_ceil(count)) {
                all.groups.push(Group {
                    first_word: first_words[shape].unwrap_or(0),
                    rest: work.quads.vertices[shape],
                    first_scale: work.first_scale[shape],
                    vertices: of.mesh.rest().len() as u32,
                    first_member: all.members.len() as u32,
                    chunks: chunks_of(scene, of) as u32,
                    members: list.len() as u32,
                });
                all.members.extend(list.iter().map(|domain| Member {
                    first: scene.layout.slots[*domain].first_vertex as u32,
                    first_q: coordinates.first[*domain],
                    domain: *domain as u32,
                    first_tile: work.spans[*domain][0].0,
                }));
                all.most = all.most.max(list.len());
            }
            all.chunks = all.chunks.max(chunks_of(scene, of));
            // Groups of one shape side by side: what one reads of U the next one finds in the cache.
            let tiles = quads_of(of).div_ceil(TILE_QUADS) as u32;
            let groups = first_group as u32..all.groups.len() as u32;
            all.blocks.extend((0..tiles).flat_map(|tile| groups.clone().map(move |group| Block { group, tile })));
        }
        all
    }
}
