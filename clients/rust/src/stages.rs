//! Times of the server's processing stages.

use std::collections::BTreeMap;

use modalcast_proto::v1;

/// Milliseconds per processing stage, under the server's stage names and in its order.
pub type StageTimes = Vec<(String, f32)>;

/// Maximum number of times per stage in a [`StageSamples`], so that its memory is bounded.
const MAX_SAMPLES: usize = 1 << 16;

pub(crate) fn from_wire(wire: Vec<v1::StageTime>) -> StageTimes {
    wire.into_iter().map(|time| (time.stage, time.milliseconds)).collect()
}

/// The times of each stage over many replies. Only the first 65,536 times of a stage are stored.
#[derive(Debug, Clone, Default)]
pub struct StageSamples(BTreeMap<String, Vec<f32>>);

impl StageSamples {
    /// Adds the times of one reply.
    pub fn add(&mut self, times: &StageTimes) {
        for (stage, milliseconds) in times {
            let samples = match self.0.get_mut(stage) {
                Some(samples) => samples,
                None => self.0.entry(stage.clone()).or_default(),
            };
            if samples.len() < MAX_SAMPLES {
                samples.push(*milliseconds);
            }
        }
    }

    /// The median time of each stage in milliseconds; the larger of the two middle times for an even count.
    pub fn medians(&self) -> BTreeMap<String, f32> {
        let median = |samples: &Vec<f32>| {
            let mut sorted = samples.clone();
            sorted.sort_by(f32::total_cmp);
            sorted.get(sorted.len() / 2).copied()
        };
        self.0.iter().filter_map(|(stage, samples)| Some((stage.clone(), median(samples)?))).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn medians_are_per_stage_and_memory_is_bounded() {
        let mut samples = StageSamples::default();
        assert!(samples.medians().is_empty());
        for milliseconds in [3.0, 1.0, 2.0] {
            samples.add(&vec![("draw".to_owned(), milliseconds)]);
        }
        for _ in 0..2 * MAX_SAMPLES {
            samples.add(&vec![("read".to_owned(), 7.0)]);
        }
        let medians = samples.medians();
        assert_eq!((medians["draw"], medians["read"]), (2.0, 7.0));
        assert_eq!(samples.0["read"].len(), MAX_SAMPLES);
    }
}
