//! Division of long outputs into pieces. A piece is drawn without a break, and between two pieces the device executes
//! commands of other scenes.
//!
//! How long a triangle takes is not known before it is drawn: it may cover no sample or all samples of an image. So the
//! first piece of a pass is small even if each of its triangles covers the image. A later piece has up to
//! [`MAX_GROWTH`] times the triangles of the piece before it, as many as the time of that piece allows. Triangles that
//! take longer than those before them may exceed the time. To bound this case, a piece contains at most
//! [`PieceLimits::max_samples`], or a fraction of all triangles ([`MAX_PIECES`]), because the many triangles of a large
//! scene cover few samples each.
//!
//! Most outputs take less time than a piece. Once an output of a size was measured, such outputs are drawn whole
//! ([`OutputCosts`]).

use std::cell::RefCell;
use std::collections::HashMap;

/// Maximum ratio of the triangles of a piece to those of the piece before it.
const MAX_GROWTH: f64 = 4.0;
/// The number of pieces into which [`PieceLimits::max_samples`] divides a pass at most.
const MAX_PIECES: usize = 64;
/// The cost of an output falls by this factor per output if later outputs take less time.
const COST_DECAY: f64 = 0.98;
/// The least number of samples that a triangle counts for, because a triangle without samples takes time, too.
const MIN_SAMPLES: u64 = 64;

/// Consecutive items of a pass: triangles of a scene in draw order, or tiles of a list.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct PieceRange {
    pub(crate) first: usize,
    pub(crate) end: usize,
}

impl PieceRange {
    pub(crate) const ALL: Self = Self { first: 0, end: usize::MAX };

    /// `count` items from `first` on.
    pub(crate) const fn new(first: usize, count: usize) -> Self {
        Self { first, end: first + count }
    }

    pub(crate) const fn count(self) -> usize {
        self.end - self.first
    }

    /// The items in both ranges; empty if there are none.
    pub(crate) fn intersection(self, other: Self) -> Self {
        let first = self.first.max(other.first);
        Self { first, end: self.end.min(other.end).max(first) }
    }
}

/// Size of the pieces on one kind of device.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PieceLimits {
    /// Time of a piece in milliseconds.
    pub(crate) target_ms: f64,
    /// Samples of the first piece of a pass, if each triangle covers all samples of its image.
    pub(crate) first_samples: u64,
    /// Maximum samples of a piece, counted in the same way, unless that makes more than [`MAX_PIECES`] pieces.
    pub(crate) max_samples: u64,
}

impl PieceLimits {
    /// An H200 draws about 2^35 samples of depth per second if work of another context runs between the pieces.
    pub(crate) const HARDWARE: Self = Self { target_ms: 50.0, first_samples: 1 << 30, max_samples: 1 << 32 };
    /// Two cores draw about 2^29 samples per second with llvmpipe.
    pub(crate) const SOFTWARE: Self = Self { target_ms: 500.0, first_samples: 1 << 28, max_samples: 1 << 32 };
}

/// The items of a pass and their cost.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PieceLoad {
    pub(crate) items: PieceRange,
    /// The number of samples that an item covers at most.
    pub(crate) samples: u64,
    /// How many times longer a sample takes at most than one of a depth pass.
    pub(crate) sample_cost: u64,
}

/// The items of a pass that are not drawn yet.
#[derive(Debug)]
pub(crate) struct PieceCursor {
    limits: PieceLimits,
    remaining: PieceRange,
    /// Number of items of the last piece.
    last_count: usize,
    /// Number of items of the next piece.
    next_count: usize,
    max_count: usize,
}

impl PieceCursor {
    /// Begins with the first item. Only the first piece depends on the cost of a sample, because it is an upper bound.
    pub(crate) fn new(limits: PieceLimits, load: PieceLoad) -> Self {
        let samples = load.samples.max(MIN_SAMPLES);
        let to_count = |piece_samples: u64| (piece_samples / samples).max(1) as usize;
        let [next_count, max_count] =
            [limits.first_samples / load.sample_cost.max(1), limits.max_samples].map(to_count);
        let max_count = max_count.max(load.items.count() / MAX_PIECES);
        Self { limits, remaining: load.items, last_count: 0, next_count, max_count }
    }

    /// The items of the next piece.
    pub(crate) fn next_piece(&mut self) -> PieceRange {
        self.last_count = self.next_count.min(self.remaining.count());
        let piece = PieceRange::new(self.remaining.first, self.last_count);
        self.remaining.first = piece.end;
        piece
    }

    /// Sets the size of the next piece by the time of the last one.
    pub(crate) fn record_ms(&mut self, ms: f64) {
        let growth = (self.limits.target_ms / ms).min(MAX_GROWTH);
        self.next_count = ((self.last_count as f64 * growth) as usize).clamp(1, self.max_count);
    }

    pub(crate) const fn is_finished(&self) -> bool {
        self.remaining.first >= self.remaining.end
    }
}

/// Outputs of one scene that take a similar time if the scene does not change.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct OutputClass {
    kind: OutputKind,
    samples_per_pixel: u32,
    /// Binary logarithm of the number of samples, rounded down.
    size_class: u32,
}

/// What an output draws.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum OutputKind {
    Frame { draws_shadow: bool },
    Aov,
}

impl OutputClass {
    pub(crate) fn new(kind: OutputKind, [width, height]: [u32; 2], samples_per_pixel: u32) -> Self {
        let samples = u64::from(width) * u64::from(height) * u64::from(samples_per_pixel);
        Self { kind, samples_per_pixel, size_class: samples.checked_ilog2().unwrap_or(0) }
    }

    /// The class of the same output with a shadow map, which takes longer.
    const fn with_shadow(self) -> Self {
        match self.kind {
            OutputKind::Frame { .. } => Self { kind: OutputKind::Frame { draws_shadow: true }, ..self },
            OutputKind::Aov => self,
        }
    }
}

/// Device times of the recent outputs of a scene in milliseconds. The number of classes is bounded by the sizes of
/// outputs.
#[derive(Debug, Default)]
pub(crate) struct OutputCosts(RefCell<HashMap<OutputClass, f64>>);

impl OutputCosts {
    /// Whether an output is drawn in pieces: it is the first of its class, or recent ones took longer than a piece. The
    /// first frame without a shadow map takes at most the time of those with one.
    pub(crate) fn has_pieces(&self, class: OutputClass, limits: PieceLimits) -> bool {
        let costs = self.0.borrow();
        let cost_ms = costs.get(&class).or_else(|| costs.get(&class.with_shadow()));
        cost_ms.is_none_or(|ms| *ms > limits.target_ms)
    }

    /// Records the device time of an output.
    pub(crate) fn record(&self, class: OutputClass, ms: f64) {
        let mut costs = self.0.borrow_mut();
        let cost_ms = costs.entry(class).or_insert(ms);
        *cost_ms = ms.max(COST_DECAY * *cost_ms);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: PieceLimits = PieceLimits { target_ms: 50.0, first_samples: 1 << 20, max_samples: 1 << 26 };
    const SAMPLES: u64 = 1 << 12;

    /// Sizes of the pieces of 100,000 triangles, and their times if a triangle takes `cost_ms`.
    fn draw_pieces(cost_ms: impl Fn(usize) -> f64) -> (Vec<usize>, Vec<f64>) {
        let load = PieceLoad { items: PieceRange::new(7, 100_000), samples: SAMPLES, sample_cost: 1 };
        let mut cursor = PieceCursor::new(LIMITS, load);
        let (mut sizes, mut times, mut next_triangle) = (Vec::new(), Vec::new(), 7);
        while !cursor.is_finished() {
            let piece = cursor.next_piece();
            assert_eq!(piece.first, next_triangle, "expected pieces without gaps");
            next_triangle = piece.end;
            let ms = (piece.first..piece.end).map(&cost_ms).sum();
            cursor.record_ms(ms);
            sizes.push(piece.count());
            times.push(ms);
        }
        assert_eq!(next_triangle, 100_007);
        (sizes, times)
    }

    #[test]
    fn pieces_of_cheap_triangles_grow_up_to_the_limit() {
        let (sizes, _) = draw_pieces(|_| 1e-6);
        assert_eq!(sizes[..4], [256, 1024, 4096, 16384]);
        assert!(sizes[4..].iter().all(|size| *size <= 16384), "expected at most 2^26 samples, got {sizes:?}");
    }

    #[test]
    fn pieces_of_expensive_triangles_take_the_target_time() {
        let (_, times) = draw_pieces(|_| 0.05);
        assert!(times.iter().all(|ms| *ms <= 50.0 + 0.05), "{times:?}");
        assert!(times.len() < 110, "expected pieces near the target time, got {} pieces", times.len());
        // A triangle that takes longer than a piece is a piece of its own.
        let (sizes, _) = draw_pieces(|triangle| if triangle < 300 { 200.0 } else { 1e-6 });
        assert!(sizes[1..37].iter().all(|size| *size == 1), "{:?}", &sizes[..40]);
    }

    #[test]
    fn pieces_shrink_when_triangles_become_expensive() {
        let (sizes, times) = draw_pieces(|triangle| if triangle < 50_000 { 1e-5 } else { 0.02 });
        let longest = times.iter().copied().fold(0.0, f64::max);
        let max_count = (LIMITS.max_samples / SAMPLES) as f64;
        assert!(longest > 60.0, "control: expected a piece that took longer than the target, got {longest} ms");
        assert!(longest <= 0.02 * max_count, "{longest} ms");
        assert!(sizes.last().is_some_and(|size| *size <= 2500), "{sizes:?}");
    }

    #[test]
    fn outputs_have_pieces_until_they_are_known_to_be_short() {
        let class = OutputClass::new(OutputKind::Aov, [640, 400], 1);
        let costs = OutputCosts::default();
        assert!(costs.has_pieces(class, LIMITS));
        costs.record(class, 3.0);
        assert!(!costs.has_pieces(class, LIMITS));
        for other in [
            OutputClass::new(OutputKind::Aov, [1280, 800], 1),
            OutputClass::new(OutputKind::Aov, [640, 400], 4),
            OutputClass::new(OutputKind::Frame { draws_shadow: false }, [640, 400], 1),
        ] {
            assert!(costs.has_pieces(other, LIMITS), "{other:?}");
        }
        let [with_shadow, without_shadow] =
            [true, false].map(|draws_shadow| OutputClass::new(OutputKind::Frame { draws_shadow }, [640, 400], 1));
        costs.record(with_shadow, 3.0);
        assert!(!costs.has_pieces(without_shadow, LIMITS));
        costs.record(class, 400.0);
        let short_outputs = (0..1000).take_while(|_| {
            costs.record(class, 3.0);
            costs.has_pieces(class, LIMITS)
        });
        // ln(400 / 50) / -ln(0.98) = 103.
        assert_eq!(short_outputs.count(), 102);
    }

    #[test]
    fn intersection_of_ranges_may_be_empty() {
        let range = PieceRange::new(10, 5);
        assert_eq!(range.intersection(PieceRange::ALL), range);
        assert_eq!(range.intersection(PieceRange::new(12, 9)), PieceRange::new(12, 3));
        assert_eq!(range.intersection(PieceRange::new(15, 9)).count(), 0);
        assert_eq!(range.intersection(PieceRange::new(2, 3)).count(), 0);
    }
}
