//! Cuts the packed vertices or corners of a scene into tiles, so that one huge domain and many small ones share cores
//! alike.

/// The largest number of items in a tile: 3 KiB of sums, which stay in the first-level cache.
pub(super) const TILE: usize = 256;

/// `count` items of one domain from its item `first`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Tile {
    pub(super) domain: usize,
    pub(super) first: usize,
    pub(super) count: usize,
}

/// Tiles of all domains in packed order: they cover every item once, without gaps.
pub(super) fn cut(counts: impl Iterator<Item = usize>) -> Vec<Tile> {
    let tiles_of = |(domain, count): (usize, usize)| {
        let tile = move |first| Tile { domain, first, count: TILE.min(count - first) };
        (0..count).step_by(TILE).map(tile)
    };
    counts.enumerate().flat_map(tiles_of).collect()
}

/// Pairs each tile with its part of a packed output of `width` numbers per item.
pub(super) fn share<'a>(tiles: &'a [Tile], mut output: &'a mut [f32], width: usize) -> Vec<(Tile, &'a mut [f32])> {
    let mut pairs = Vec::with_capacity(tiles.len());
    for tile in tiles {
        let (part, rest) = output.split_at_mut(width * tile.count);
        pairs.push((*tile, part));
        output = rest;
    }
    pairs
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiles_cover_every_item_once_in_order() {
        let counts = [0, 1, TILE, TILE + 1, 3 * TILE - 1];
        let tiles = cut(counts.into_iter());
        assert_eq!(tiles.iter().map(|tile| tile.count).sum::<usize>(), counts.iter().sum::<usize>());
        assert!(tiles.iter().all(|tile| tile.count >= 1 && tile.count <= TILE));
        assert_eq!(tiles.iter().map(|tile| tile.domain).collect::<Vec<_>>(), [1, 2, 3, 3, 4, 4, 4]);
        let mut output = vec![0.0; 3 * counts.iter().sum::<usize>()];
        for (tile, part) in share(&tiles, &mut output, 3) {
            assert_eq!(part.len(), 3 * tile.count);
            part.iter_mut().for_each(|number| *number += 1.0);
        }
        assert!(output.iter().all(|number| *number == 1.0));
    }
}
