//! Divides the vertices or the corners of a scene into tiles, and each output into one part per tile. "Packed" items
//! are those of all domains, one domain after the other. Tiles balance the load between cores, for one large domain as
//! for many small ones.

use super::changes::ChangeTracker;

/// Consecutive items (vertices or corners) of one domain.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct DomainTile {
    pub(super) domain: u32,
    /// Index of the first item in the domain.
    first_item: u32,
    item_count: u32,
    /// Index of the first item among the packed items of all domains.
    first_packed_item: u32,
    /// Index of the tile among all tiles.
    index: u32,
}

impl DomainTile {
    pub(super) const fn domain(&self) -> usize {
        self.domain as usize
    }

    /// Index of the first item in the domain.
    pub(super) const fn first_item(&self) -> usize {
        self.first_item as usize
    }

    pub(super) const fn item_count(&self) -> usize {
        self.item_count as usize
    }
}

/// All tiles of a scene, and the tiles of the domains that changed in a step.
#[derive(Debug)]
pub(super) struct WorkList {
    all_tiles: Vec<DomainTile>,
    /// The first tile of each domain, followed by the number of tiles.
    first_tiles: Vec<usize>,
    changed_tiles: Vec<DomainTile>,
}

impl WorkList {
    /// Creates tiles of at most `max_items` items for domains with these numbers of items, in packed order. Each item
    /// is in one tile.
    pub(super) fn new(item_counts: impl Iterator<Item = usize>, max_items: usize) -> Self {
        let (mut all_tiles, mut first_tiles, mut first_packed_item) = (Vec::new(), vec![0], 0);
        for (domain, domain_items) in item_counts.enumerate() {
            for first_item in (0..domain_items).step_by(max_items) {
                let item_count = max_items.min(domain_items - first_item) as u32;
                all_tiles.push(DomainTile {
                    domain: domain as u32,
                    first_item: first_item as u32,
                    item_count,
                    first_packed_item,
                    index: all_tiles.len() as u32,
                });
                first_packed_item += item_count;
            }
            first_tiles.push(all_tiles.len());
        }
        Self { changed_tiles: Vec::with_capacity(all_tiles.len()), all_tiles, first_tiles }
    }

    /// Number of all tiles.
    pub(super) const fn len(&self) -> usize {
        self.all_tiles.len()
    }

    /// The range of a domain's tiles among all tiles.
    pub(super) fn tiles_of(&self, domain: usize) -> std::ops::Range<usize> {
        self.first_tiles[domain]..self.first_tiles[domain + 1]
    }

    /// The tiles of the domains that changed, in packed order.
    pub(super) fn select_changed(&mut self, changes: &ChangeTracker) -> &[DomainTile] {
        let Some(domains) = changes.changed_domains() else { return &self.all_tiles };
        self.changed_tiles.clear();
        for domain in domains {
            let tiles = self.tiles_of(*domain as usize);
            self.changed_tiles.extend_from_slice(&self.all_tiles[tiles]);
        }
        &self.changed_tiles
    }
}

/// An output that can be split where a tile begins.
pub(super) trait SplitOutput: Sized + Send {
    /// Returns the part before the first item of `tile`, and the part from that item on.
    fn split_at_tile(self, tile: &DomainTile) -> (Self, Self);
}

/// A part of an output with `width` numbers per packed item.
#[derive(Debug)]
pub(super) struct PackedOutput<'a> {
    /// Index of the first packed item of the part.
    first_item: usize,
    /// Numbers per item.
    width: usize,
    numbers: &'a mut [f32],
}

impl<'a> PackedOutput<'a> {
    /// The complete output.
    pub(super) const fn new(width: usize, numbers: &'a mut [f32]) -> Self {
        Self { first_item: 0, width, numbers }
    }

    /// The numbers of a tile.
    pub(super) fn numbers_of(&mut self, tile: &DomainTile) -> &mut [f32] {
        let start = self.width * (tile.first_packed_item as usize - self.first_item);
        &mut self.numbers[start..][..self.width * tile.item_count()]
    }
}

impl SplitOutput for PackedOutput<'_> {
    fn split_at_tile(self, tile: &DomainTile) -> (Self, Self) {
        let first_item = tile.first_packed_item as usize;
        let (left, right) = self.numbers.split_at_mut(self.width * (first_item - self.first_item));
        (Self { numbers: left, ..self }, Self { first_item, width: self.width, numbers: right })
    }
}

/// A part of an output with one value per tile.
#[derive(Debug)]
pub(super) struct PerTileOutput<'a, T> {
    /// Index of the first tile of the part.
    first_tile: usize,
    values: &'a mut [T],
}

impl<'a, T> PerTileOutput<'a, T> {
    /// The complete output.
    pub(super) const fn new(values: &'a mut [T]) -> Self {
        Self { first_tile: 0, values }
    }

    /// The value of a tile.
    pub(super) fn value_of(&mut self, tile: &DomainTile) -> &mut T {
        &mut self.values[tile.index as usize - self.first_tile]
    }
}

impl<T: Send> SplitOutput for PerTileOutput<'_, T> {
    fn split_at_tile(self, tile: &DomainTile) -> (Self, Self) {
        let first_tile = tile.index as usize;
        let (left, right) = self.values.split_at_mut(first_tile - self.first_tile);
        (Self { first_tile: self.first_tile, values: left }, Self { first_tile, values: right })
    }
}

/// An output that not every scene has.
impl<O: SplitOutput> SplitOutput for Option<O> {
    fn split_at_tile(self, tile: &DomainTile) -> (Self, Self) {
        self.map(|output| output.split_at_tile(tile)).map_or((None, None), |(left, right)| (Some(left), Some(right)))
    }
}

impl<A: SplitOutput, B: SplitOutput> SplitOutput for (A, B) {
    fn split_at_tile(self, tile: &DomainTile) -> (Self, Self) {
        let ((left_a, right_a), (left_b, right_b)) = (self.0.split_at_tile(tile), self.1.split_at_tile(tile));
        ((left_a, left_b), (right_a, right_b))
    }
}

/// Calls `process` in parallel with runs of consecutive tiles and their outputs.
pub(super) fn run_parallel<O: SplitOutput>(
    tiles: &[DomainTile],
    output: O,
    process: &(impl Fn(&[DomainTile], O) + Sync),
) {
    // About 16 runs per core balance the load. A run of many tiles reads memory sequentially.
    let max_run = (tiles.len() / (16 * rayon::current_num_threads())).clamp(4, 1024);
    split_recursive(tiles, output, max_run, process);
}

/// Halves the tiles recursively into runs of at most `max_run` tiles, and processes the runs in parallel.
fn split_recursive<O: SplitOutput>(
    tiles: &[DomainTile],
    output: O,
    max_run: usize,
    process: &(impl Fn(&[DomainTile], O) + Sync),
) {
    if tiles.len() <= max_run {
        return process(tiles, output);
    }
    let (left, right) = tiles.split_at(tiles.len() / 2);
    let (left_output, right_output) = output.split_at_tile(&right[0]);
    rayon::join(
        || split_recursive(left, left_output, max_run, process),
        || split_recursive(right, right_output, max_run, process),
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Number of items of each domain.
    const ITEM_COUNTS: [usize; 5] = [0, 1, 256, 257, 767];

    #[test]
    fn tiles_cover_every_item_once_in_order() {
        let mut work = WorkList::new(ITEM_COUNTS.into_iter(), 256);
        let tiles = work.select_changed(&ChangeTracker::with_all_changed()).to_vec();
        assert_eq!(tiles.iter().map(DomainTile::domain).collect::<Vec<_>>(), [1, 2, 3, 3, 4, 4, 4]);
        assert!(tiles.iter().all(|tile| tile.item_count() >= 1 && tile.item_count() <= 256));
        let mut output = vec![0.0; 3 * ITEM_COUNTS.iter().sum::<usize>()];
        let mut visits = vec![0; work.len()];
        let outputs = (PackedOutput::new(3, &mut output), PerTileOutput::new(&mut visits));
        split_recursive(&tiles, outputs, 1, &|tiles, outputs| {
            let (mut numbers, mut visits) = outputs;
            for tile in tiles {
                numbers.numbers_of(tile).iter_mut().for_each(|number| *number += 1.0 + tile.domain as f32);
                *visits.value_of(tile) += 1;
            }
        });
        let expected = ITEM_COUNTS.iter().enumerate().flat_map(|(domain, count)| vec![1.0 + domain as f32; 3 * count]);
        assert!(output.into_iter().eq(expected));
        assert_eq!(visits, [1; 7]);
    }

    #[test]
    fn tiles_of_changed_domains_write_only_their_items() {
        let mut work = WorkList::new(ITEM_COUNTS.into_iter(), 256);
        let mut output = vec![0.0; ITEM_COUNTS.iter().sum::<usize>()];
        let changes = ChangeTracker::with_changed(&[1, 3]);
        run_parallel(work.select_changed(&changes), PackedOutput::new(1, &mut output), &|tiles, mut numbers| {
            tiles.iter().for_each(|tile| numbers.numbers_of(tile).fill(1.0));
        });
        let value_of = |domain: usize| f32::from(u8::from([1, 3].contains(&domain)));
        let expected = ITEM_COUNTS.iter().enumerate().flat_map(|(domain, count)| vec![value_of(domain); *count]);
        assert!(output.into_iter().eq(expected));
    }
}
