//! Cuts the packed vertices or corners of a scene into tiles, and gives each tile its part of the outputs. The tiles
//! balance the load between cores for one huge domain as well as for many small ones.

use super::changes::Changes;

/// `count` consecutive items of one domain, from item `first` on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Tile {
    pub(super) domain: u32,
    first: u32,
    count: u32,
    /// Index of the first item among the packed items of all domains.
    packed: u32,
    /// Index of the tile among all tiles.
    index: u32,
}

impl Tile {
    pub(super) const fn domain(&self) -> usize {
        self.domain as usize
    }

    /// The first item in the domain.
    pub(super) const fn first(&self) -> usize {
        self.first as usize
    }

    pub(super) const fn count(&self) -> usize {
        self.count as usize
    }
}

/// All tiles of a scene, and those of one step.
#[derive(Debug)]
pub(super) struct Work {
    all: Vec<Tile>,
    /// The first tile of each domain, followed by the number of tiles.
    first_tiles: Vec<usize>,
    active: Vec<Tile>,
}

impl Work {
    /// Tiles of at most `size` items for domains with these item counts, in packed order; they cover every item once.
    pub(super) fn new(counts: impl Iterator<Item = usize>, size: usize) -> Self {
        let (mut all, mut first_tiles, mut packed) = (Vec::new(), vec![0], 0);
        for (domain, count) in counts.enumerate() {
            for first in (0..count).step_by(size) {
                let [domain, first, count] = [domain, first, size.min(count - first)].map(|number| number as u32);
                all.push(Tile { domain, first, count, packed, index: all.len() as u32 });
                packed += count;
            }
            first_tiles.push(all.len());
        }
        Self { active: Vec::with_capacity(all.len()), all, first_tiles }
    }

    /// Number of all tiles.
    pub(super) const fn len(&self) -> usize {
        self.all.len()
    }

    /// The range of a domain's tiles among all tiles.
    pub(super) fn tiles_of(&self, domain: usize) -> std::ops::Range<usize> {
        self.first_tiles[domain]..self.first_tiles[domain + 1]
    }

    /// The tiles of the domains that changed, in packed order.
    pub(super) fn of(&mut self, changes: &Changes) -> &[Tile] {
        let Some(domains) = changes.some() else { return &self.all };
        self.active.clear();
        for domain in domains {
            let tiles = self.tiles_of(*domain as usize);
            self.active.extend_from_slice(&self.all[tiles]);
        }
        &self.active
    }
}

/// An output that can be split at the begin of a tile.
pub(super) trait Output: Sized + Send {
    /// The part before the tile, and the rest.
    fn cut(self, at: &Tile) -> (Self, Self);
}

/// A part of an output with `width` numbers per packed item.
#[derive(Debug)]
pub(super) struct Packed<'a> {
    first: usize,
    width: usize,
    numbers: &'a mut [f32],
}

impl<'a> Packed<'a> {
    /// The whole output.
    pub(super) const fn new(width: usize, numbers: &'a mut [f32]) -> Self {
        Self { first: 0, width, numbers }
    }

    /// The numbers of a tile.
    pub(super) fn of(&mut self, tile: &Tile) -> &mut [f32] {
        let begin = self.width * (tile.packed as usize - self.first);
        &mut self.numbers[begin..][..self.width * tile.count()]
    }
}

impl Output for Packed<'_> {
    fn cut(self, at: &Tile) -> (Self, Self) {
        let first = at.packed as usize;
        let (left, right) = self.numbers.split_at_mut(self.width * (first - self.first));
        (Self { numbers: left, ..self }, Self { first, width: self.width, numbers: right })
    }
}

/// A part of an output with one value per tile.
#[derive(Debug)]
pub(super) struct PerTile<'a, T> {
    first: usize,
    values: &'a mut [T],
}

impl<'a, T> PerTile<'a, T> {
    /// The whole output.
    pub(super) const fn new(values: &'a mut [T]) -> Self {
        Self { first: 0, values }
    }

    /// The value of a tile.
    pub(super) fn of(&mut self, tile: &Tile) -> &mut T {
        &mut self.values[tile.index as usize - self.first]
    }
}

impl<T: Send> Output for PerTile<'_, T> {
    fn cut(self, at: &Tile) -> (Self, Self) {
        let first = at.index as usize;
        let (left, right) = self.values.split_at_mut(first - self.first);
        (Self { first: self.first, values: left }, Self { first, values: right })
    }
}

/// An output that not every scene has.
impl<O: Output> Output for Option<O> {
    fn cut(self, at: &Tile) -> (Self, Self) {
        self.map(|output| output.cut(at)).map_or((None, None), |(left, right)| (Some(left), Some(right)))
    }
}

impl<A: Output, B: Output, C: Output> Output for (A, B, C) {
    fn cut(self, at: &Tile) -> (Self, Self) {
        let ((a, b), c) = ((self.0, self.1).cut(at), self.2.cut(at));
        ((a.0, a.1, c.0), (b.0, b.1, c.1))
    }
}

impl<A: Output, B: Output> Output for (A, B) {
    fn cut(self, at: &Tile) -> (Self, Self) {
        let ((a, b), (c, d)) = (self.0.cut(at), self.1.cut(at));
        ((a, c), (b, d))
    }
}

/// Runs `op` in parallel on runs of neighboring tiles with their outputs.
pub(super) fn spread<O: Output>(tiles: &[Tile], output: O, op: &(impl Fn(&[Tile], O) + Sync)) {
    // Several runs per core balance the load; a run of many tiles reads memory sequentially.
    let run = (tiles.len() / (16 * rayon::current_num_threads())).clamp(4, 1024);
    halve(tiles, output, run, op);
}

fn halve<O: Output>(tiles: &[Tile], output: O, run: usize, op: &(impl Fn(&[Tile], O) + Sync)) {
    if tiles.len() <= run {
        return op(tiles, output);
    }
    let (left, right) = tiles.split_at(tiles.len() / 2);
    let (before, after) = output.cut(&right[0]);
    rayon::join(|| halve(left, before, run, op), || halve(right, after, run, op));
}

#[cfg(test)]
mod tests {
    use super::*;

    const COUNTS: [usize; 5] = [0, 1, 256, 257, 767];

    #[test]
    fn tiles_cover_every_item_once_in_order() {
        let mut work = Work::new(COUNTS.into_iter(), 256);
        let tiles = work.of(&Changes::all()).to_vec();
        assert_eq!(tiles.iter().map(Tile::domain).collect::<Vec<_>>(), [1, 2, 3, 3, 4, 4, 4]);
        assert!(tiles.iter().all(|tile| tile.count() >= 1 && tile.count() <= 256));
        let mut output = vec![0.0; 3 * COUNTS.iter().sum::<usize>()];
        let mut seen = vec![0; work.len()];
        let parts = (Packed::new(3, &mut output), PerTile::new(&mut seen));
        halve(work.of(&Changes::all()), parts, 1, &|tiles, (mut numbers, mut seen)| {
            for tile in tiles {
                numbers.of(tile).iter_mut().for_each(|number| *number += 1.0 + tile.domain as f32);
                *seen.of(tile) += 1;
            }
        });
        let want = COUNTS.iter().enumerate().flat_map(|(at, count)| vec![1.0 + at as f32; 3 * count]);
        assert!(output.into_iter().eq(want));
        assert_eq!(seen, [1; 7]);
    }

    #[test]
    fn tiles_of_what_changed_leave_the_rest_alone() {
        let mut work = Work::new(COUNTS.into_iter(), 256);
        let mut output = vec![0.0; COUNTS.iter().sum::<usize>()];
        let changes = Changes::of(&[1, 3]);
        spread(work.of(&changes), Packed::new(1, &mut output), &|tiles, mut numbers| {
            tiles.iter().for_each(|tile| numbers.of(tile).fill(1.0));
        });
        let want = COUNTS.iter().enumerate().flat_map(|(at, count)| vec![f32::from(u8::from(at % 2 == 1)); *count]);
        assert!(output.into_iter().eq(want));
    }
}
