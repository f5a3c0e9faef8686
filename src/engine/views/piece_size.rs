//! The number of views that the device draws without a break. Between two pieces it serves other scenes.

/// Time of a piece in milliseconds.
const TARGET_MS: f64 = 25.0;
/// Views of the first piece. A core draws a view of 64 x 64 pixels and a few thousand triangles in about 1 ms.
const FIRST_VIEWS: usize = 16;
/// Maximum ratio of the views of a piece to those of the piece before it, because its views may take longer.
const MAX_GROWTH: f64 = 4.0;

#[derive(Debug)]
pub(super) struct PieceSize {
    views: usize,
    max_views: usize,
}

impl PieceSize {
    pub(super) fn new(max_views: usize) -> Self {
        Self { views: FIRST_VIEWS.min(max_views), max_views }
    }

    pub(super) const fn get(&self) -> usize {
        self.views
    }

    /// Sets the size of the next piece by the time of one with `count` views. The last piece of a step may be smaller
    /// than the others, which does not make the next ones small.
    pub(super) fn record(&mut self, count: usize, ms: f64) {
        let within_target = (count as f64 * (TARGET_MS / ms.max(1e-6)).min(MAX_GROWTH)) as usize;
        if count == self.views || within_target > self.views || ms > TARGET_MS {
            self.views = within_target.clamp(1, self.max_views);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_grow_and_shrink_with_their_time_within_the_bounds() {
        let mut size = PieceSize::new(1000);
        let mut record = |count: usize, ms: f64| {
            size.record(count, ms);
            size.get()
        };
        assert_eq!(record(16, 0.1), 64);
        assert_eq!(record(64, 0.1), 256);
        assert_eq!(record(3, 0.1), 256, "expected the last views of a step to change nothing");
        assert_eq!(record(256, 0.1), 1000);
        assert_eq!(record(1000, 50.0), 500);
        assert_eq!(record(500, 1e9), 1);
        assert_eq!(record(1, 0.0), 4);
    }

    #[test]
    fn first_piece_has_at_most_the_largest_size() {
        assert_eq!(PieceSize::new(2).get(), 2);
    }
}
