//! Cuts the packed vertices or corners of a scene into tiles, and gives each tile its part of the outputs. The tiles
//! balance the load between cores for one huge domain as well as for many small ones.

use super::changes::ChangeTracker;

/// `count` consecutive items of one domain, from item `first` on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct DomainTile {
    pub(super) domain: u32,
    first: u32,
    count: u32,
    /// Index of the first item among the packed items of all domains.
    packed: u32,
    /// Index of the tile among all tiles.
    index: u32,
}

impl DomainTile {
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
pub(super) struct WorkList {
    all: Vec<DomainTile>,
    /// The first tile of each domain, followed by the number of tiles.
    first_tiles: Vec<usize>,
    active: Vec<DomainTile>,
}

impl WorkList {
    /// Tiles of at most `size` items for domains with these item counts, in packed order; they cover every item once.
    pub(super) fn new(counts: impl Iterator<Item = usize>, size: usize) -> Self {
        let (mut all, mut first_tiles, mut packed) = (Vec::new(), vec![0], 0);
        for (domain, count) in counts.enumerate() {
            for first in (0..count).step_by(size) {
                let [domain, first, count] = [domain, first, size.min(count - first)].map(|number| number as u32);
                all.push(DomainTile { domain, first, count, packed, index: all.len() as u32 });
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
    pub(super) fn of(&mut self, changes: &ChangeTracker) -> &[DomainTile] {
        let Some(domains) = changes.changed_domains() else { return &self.all };
        self.active.clear();
        for domain in domains {
            let tiles = self.tiles_of(*domain as usize);
            self.active.extend_from_slice(&self.all[tiles]);
        }
        &self.active
    }
}

/// An output that can be split at the begin of a tile.
pub(super) trait SplitOutput: Sized + Send {
    /// The part before the tile, and the rest.
    fn split_at_tile(self, at: &DomainTile) -> (Self, Self);
}

/// A part of an output with `width` numbers per packed item.
#[derive(Debug)]
pub(super) struct PackedOutput<'a> {
    first: usize,
    width: usize,
    numbers: &'a mut [f32],
}

impl<'a> PackedOutput<'a> {
    /// The whole output.
    pub(super) const fn new(width: usize, numbers: &'a mut [f32]) -> Self {
        Self { first: 0, width, numbers }
    }

    /// The numbers of a tile.
    pub(super) fn of(&mut self, tile: &DomainTile) -> &mut [f32] {
        let begin = self.width * (tile.packed as usize - self.first);
        &mut self.numbers[begin..][..self.width * tile.count()]
    }
}

impl SplitOutput for PackedOutput<'_> {
    fn split_at_tile(self, at: &DomainTile) -> (Self, Self) {
        let first = at.packed as usize;
        let (left, right) = self.numbers.split_at_mut(self.width * (first - self.first));
        (Self { numbers: left, ..self }, Self { first, width: self.width, numbers: right })
    }
}

/// A part of an output with one value per tile.
#[derive(Debug)]
pub(super) struct PerTileOutput<'a, T> {
    first: usize,
    values: &'a mut [T],
}

impl<'a, T> PerTileOutput<'a, T> {
    /// The whole output.
    pub(super) const fn new(values: &'a mut [T]) -> Self {
        Self { first: 0, values }
    }

    /// The value of a tile.
    pub(super) fn of(&mut self, tile: &DomainTile) -> &mut T {
        &mut self.values[tile.index as usize - self.first]
    }
}

impl<T: Send> SplitOutput for PerTileOutput<'_, T> {
    fn split_at_tile(self, at: &DomainTile) -> (Self, Self) {
        let first = at.index as usize;
        let (left, right) = self.values.split_at_mut(first - self.first);
        (Self { first: self.first, values: left }, Self { first, values: right })
    }
}

/// An output that not every scene has.
impl<O: SplitOutput> SplitOutput for Option<O> {
    fn split_at_tile(self, at: &DomainTile) -> (Self, Self) {
        self.map(|output| output.split_at_tile(at)).map_or((None, None), |(left, right)| (Some(left), Some(right)))
    }
}

impl<A: SplitOutput, B: SplitOutput, C: SplitOutput> SplitOutput for (A, B, C) {
    fn split_at_tile(self, at: &DomainTile) -> (Self, Self) {
        let ((a, b), c) = ((self.0, self.1).split_at_tile(at), self.2.split_at_tile(at));
        ((a.0, a.1, c.0), (b.0, b.1, c.1))
    }
}

impl<A: SplitOutput, B: SplitOutput> SplitOutput for (A, B) {
    fn split_at_tile(self, at: &DomainTile) -> (Self, Self) {
        let ((a, b), (c, d)) = (self.0.split_at_tile(at), self.1.split_at_tile(at));
        ((a, c), (b, d))
    }
}

/// Runs `op` in parallel on runs of neighboring tiles with their outputs.
pub(super) fn run_parallel<O: SplitOutput>(tiles: &[DomainTile], output: O, op: &(impl Fn(&[DomainTile], O) + Sync)) {
    // Several runs per core balance the load; a run of many tiles reads memory sequentially.
    let run = (tiles.len() / (16 * rayon::current_num_threads())).clamp(4, 1024);
    split_recursive(tiles, output, run, op);
}

fn split_recursive<O: SplitOutput>(
    tiles: &[DomainTile],
    output: O,
    run: usize,
    op: &(impl Fn(&[DomainTile], O) + Sync),
) {
    if tiles.len() <= run {
        return op(tiles, output);
    }
    let (left, right) = tiles.split_at(tiles.len() / 2);
    let (before, after) = output.split_at_tile(&right[0]);
    rayon::join(|| split_recursive(left, before, run, op), || split_recursive(right, after, run, op));
}

#[cfg(test)]
mod tests {
    use super::*;

    const COUNTS: [usize; 5] = [0, 1, 256, 257, 767];

    #[test]
    fn tiles_cover_every_item_once_in_order() {
        let mut work = WorkList::new(COUNTS.into_iter(), 256);
        let tiles = work.of(&ChangeTracker::all()).to_vec();
        assert_eq!(tiles.iter().map(DomainTile::domain).collect::<Vec<_>>(), [1, 2, 3, 3, 4, 4, 4]);
        assert!(tiles.iter().all(|tile| tile.count() >= 1 && tile.count() <= 256));
        let mut output = vec![0.0; 3 * COUNTS.iter().sum::<usize>()];
        let mut seen = vec![0; work.len()];
        let parts = (PackedOutput::new(3, &mut output), PerTileOutput::new(&mut seen));
        split_recursive(work.of(&ChangeTracker::all()), parts, 1, &|tiles, (mut numbers, mut seen)| {
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
        let mut work = WorkList::new(COUNTS.into_iter(), 256);
        let mut output = vec![0.0; COUNTS.iter().sum::<usize>()];
        let changes = ChangeTracker::of(&[1, 3]);
        run_parallel(work.of(&changes), PackedOutput::new(1, &mut output), &|tiles, mut numbers| {
            tiles.iter().for_each(|tile| numbers.of(tile).fill(1.0));
        });
        let want = COUNTS.iter().enumerate().flat_map(|(at, count)| vec![f32::from(u8::from(at % 2 == 1)); *count]);
        assert!(output.into_iter().eq(want));
    }
}
