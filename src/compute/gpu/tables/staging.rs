//! Writes staging buffers: pinned, write-combined host memory, which the host writes from front to back and never
//! reads.

use bytemuck::Pod;
use rayon::prelude::*;

/// Minimum number of bytes of a list that several cores write. The benchmark `modalcast report deform` measures one and
/// several cores below and above this limit (table `host_writes`).
pub const PARALLEL_THRESHOLD: usize = 1 << 20;
/// Number of 32-bit words after which a parallel part ends (128 KiB): long contiguous writes, but enough parts for many
/// cores.
const PART_WORDS: usize = 1 << 15;
/// Minimum number of items of a list that several cores write although it has fewer bytes than `PARALLEL_THRESHOLD`. For
/// short items, the cost per item exceeds that of writing the words.
const PARALLEL_ITEMS: usize = 1 << 13;
/// Maximum number of items per parallel part.
const PART_ITEMS: usize = 1 << 11;

/// Writes a list of 32-bit words from front to back. The field is the part that is not yet written.
pub(crate) struct SliceWriter<'a>(&'a mut [f32]);

impl<'a> SliceWriter<'a> {
    pub(crate) const fn new(list: &'a mut [f32]) -> Self {
        Self(list)
    }

    /// Writes `values` to the next words.
    pub(crate) fn put<T: Pod>(&mut self, values: &[T]) {
        let words: &[f32] = bytemuck::cast_slice(values);
        copy(self.take(words.len()), words);
    }

    /// Skips the next `count` words and returns them for the caller to write.
    pub(crate) fn take(&mut self, count: usize) -> &'a mut [f32] {
        let (skipped_words, remaining_words) = std::mem::take(&mut self.0).split_at_mut(count);
        self.0 = remaining_words;
        skipped_words
    }
}

/// Copies on several cores if the list is large enough.
fn copy(target: &mut [f32], source: &[f32]) {
    if size_of_val(source) < PARALLEL_THRESHOLD {
        target.copy_from_slice(source)
    } else {
        parallel_copy(target, source)
    }
}

/// Copies a list on several cores. Both lists have the same length.
pub fn parallel_copy(target: &mut [f32], source: &[f32]) {
    let parts = target.par_chunks_mut(PART_WORDS).zip(source.par_chunks(PART_WORDS));
    parts.for_each(|(target, source)| target.copy_from_slice(source));
}

/// Fills a list with `fill(items, part)`: `part` is a part of the list, and `items` are the items in it. An item begins
/// at word `first_word(item)`; these offsets ascend from 0. A large list is split between items into parts, which
/// several cores fill.
pub(crate) fn fill_parts<T: Sync>(
    list: &mut [f32],
    items: &[T],
    first_word: impl Fn(&T) -> usize,
    fill: impl Fn(&[T], &mut [f32]) + Sync,
) {
    if size_of_val(list) < PARALLEL_THRESHOLD && items.len() < PARALLEL_ITEMS {
        fill(items, list);
        return;
    }
    let (mut parts, mut remaining_words, mut remaining_items, mut part_begin) = (Vec::new(), list, items, 0);
    while !remaining_items.is_empty() {
        let min_part_end = part_begin + PART_WORDS;
        let item_count = remaining_items.partition_point(|item| first_word(item) < min_part_end).clamp(1, PART_ITEMS);
        let (part_items, following_items) = remaining_items.split_at(item_count);
        let part_end = following_items.first().map_or(part_begin + remaining_words.len(), &first_word);
        let (part, following_words) = remaining_words.split_at_mut(part_end - part_begin);
        parts.push((part_items, part));
        (remaining_words, remaining_items, part_begin) = (following_words, following_items, part_end);
    }
    parts.into_par_iter().for_each(|(items, part)| fill(items, part));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slice_writer_writes_short_and_long_lists_in_order() {
        for words in [
            0,
            1,
            PARALLEL_THRESHOLD / 4 - 1,
            PARALLEL_THRESHOLD / 4,
            PARALLEL_THRESHOLD / 4 + 1,
            PARALLEL_THRESHOLD + 3,
        ] {
            let numbers: Vec<f32> = (0..words).map(|index| index as f32).collect();
            let mut list = vec![-1.0; words + 3];
            let mut writer = SliceWriter::new(&mut list);
            writer.put(&[7_u32]);
            writer.put(&numbers);
            writer.take(1).fill(9.0);
            assert_eq!(writer.take(1), [-1.0]);
            assert_eq!(list[0].to_bits(), 7);
            assert!(list[1..=words] == numbers, "{words}");
            assert_eq!(list[words + 1..], [9.0, -1.0]);
        }
    }

    #[test]
    fn every_item_and_word_belongs_to_one_part() {
        // Lists of more than 262,144 words (`PARALLEL_THRESHOLD`) or 8,192 items (`PARALLEL_ITEMS`) have several parts.
        let lists = [vec![1; 400_000], vec![2; 10_000], vec![0; 5], vec![300_000, 0, 0, 7, 200_000, 0], vec![4; 3]];
        for lengths in lists {
            let item_offsets: Vec<usize> =
                lengths.iter().scan(0, |sum, length| Some(std::mem::replace(sum, *sum + length))).collect();
            // Three words after the last item belong to the last part.
            let word_count = lengths.iter().sum::<usize>() + 3;
            let mut list = vec![-1.0; word_count];
            let item_count = std::sync::atomic::AtomicUsize::new(0);
            fill_parts(
                &mut list,
                &item_offsets,
                |offset| *offset,
                |items, part| {
                    assert!(items.len() <= PART_ITEMS || items.len() < PARALLEL_ITEMS && items.len() == lengths.len());
                    item_count.fetch_add(items.len(), std::sync::atomic::Ordering::Relaxed);
                    let part_begin = items[0];
                    part.iter_mut().enumerate().for_each(|(index, word)| *word = (part_begin + index) as f32);
                },
            );
            assert_eq!(item_count.into_inner(), lengths.len());
            assert!(list.iter().enumerate().all(|(index, word)| *word == index as f32));
        }
    }
}
