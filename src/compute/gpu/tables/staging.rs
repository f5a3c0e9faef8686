//! Writes staging buffers: pinned, write-combined host memory, written from front to back and never read by the host.

use std::ops::Range;

use bytemuck::Pod;
use rayon::prelude::*;

/// Bytes from which several cores write. `report deform` measures both ways below and above this limit (`host_writes`).
pub const PARALLEL_THRESHOLD: usize = 1 << 20;
/// Words per parallel part: long runs, but enough parts for many cores.
const PART_WORDS: usize = 1 << 15;

/// The unwritten rest of a list, written from its front.
pub(crate) struct SliceWriter<'a>(&'a mut [f32]);

impl<'a> SliceWriter<'a> {
    pub(crate) const fn new(list: &'a mut [f32]) -> Self {
        Self(list)
    }

    pub(crate) fn put<T: Pod>(&mut self, values: &[T]) {
        let words: &[f32] = bytemuck::cast_slice(values);
        copy(self.take(words.len()), words);
    }

    /// The next `count` words, for the caller to write.
    pub(crate) fn take(&mut self, count: usize) -> &'a mut [f32] {
        let (part, rest) = std::mem::take(&mut self.0).split_at_mut(count);
        self.0 = rest;
        part
    }
}

/// Copies on several cores if the list is large enough.
fn copy(to: &mut [f32], from: &[f32]) {
    if size_of_val(from) < PARALLEL_THRESHOLD { to.copy_from_slice(from) } else { parallel_copy(to, from) }
}

/// Copies part by part; both lists have the same length.
pub fn parallel_copy(to: &mut [f32], from: &[f32]) {
    to.par_chunks_mut(PART_WORDS).zip(from.par_chunks(PART_WORDS)).for_each(|(to, from)| to.copy_from_slice(from));
}

/// Fills a list of items, whose first words `firsts` ascend, by `fill(items, part)`. A large list is cut at item
/// boundaries into parts that several cores fill.
pub(crate) fn fill_parts(list: &mut [f32], firsts: &[u32], fill: impl Fn(Range<usize>, &mut [f32]) + Sync) {
    if size_of_val(list) < PARALLEL_THRESHOLD {
        fill(0..firsts.len(), list);
        return;
    }
    let (mut parts, mut rest, mut begin) = (Vec::new(), list, 0);
    let mut done = firsts.first().map_or(0, |first| *first as usize);
    while begin < firsts.len() {
        let end = firsts.partition_point(|first| (*first as usize) < done + PART_WORDS).max(begin + 1);
        let until = firsts.get(end).map_or(done + rest.len(), |first| *first as usize);
        let (part, after) = rest.split_at_mut(until - done);
        parts.push((begin..end, part));
        (rest, begin, done) = (after, end, until);
    }
    parts.into_par_iter().for_each(|(items, part)| fill(items, part));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn short_and_long_lists_arrive_in_their_order() {
        for words in [
            0,
            1,
            PARALLEL_THRESHOLD / 4 - 1,
            PARALLEL_THRESHOLD / 4,
            PARALLEL_THRESHOLD / 4 + 1,
            PARALLEL_THRESHOLD + 3,
        ] {
            let numbers: Vec<f32> = (0..words).map(|at| at as f32).collect();
            let mut list = vec![-1.0; words + 3];
            let mut front = SliceWriter::new(&mut list);
            front.put(&[7_u32]);
            front.put(&numbers);
            front.take(1).fill(9.0);
            assert_eq!(front.take(1), [-1.0]);
            assert_eq!(list[0].to_bits(), 7);
            assert!(list[1..=words] == numbers, "{words}");
            assert_eq!(list[words + 1..], [9.0, -1.0]);
        }
    }

    #[test]
    fn every_item_and_every_word_falls_into_one_part_whatever_the_lengths() {
        for lengths in [vec![1; 400_000], vec![0; 5], vec![300_000, 0, 0, 7, 200_000, 0], vec![4; 3]] {
            let firsts: Vec<u32> =
                lengths.iter().scan(0, |sum, length| Some(std::mem::replace(sum, *sum + length))).collect();
            let total = lengths.iter().sum::<u32>() as usize + 3;
            let mut list = vec![-1.0; total];
            let seen = std::sync::atomic::AtomicUsize::new(0);
            fill_parts(&mut list, &firsts, |items, part| {
                seen.fetch_add(items.len(), std::sync::atomic::Ordering::Relaxed);
                let begin = firsts[items.start] as usize;
                part.iter_mut().enumerate().for_each(|(at, word)| *word = (begin + at) as f32);
            });
            assert_eq!(seen.into_inner(), lengths.len());
            assert!(list.iter().enumerate().all(|(at, word)| *word == at as f32));
        }
    }
}
