//! The values of domains over all states, gathered for a group of domains at a time.

use std::ops::Range;

use crate::error::Result;
use crate::reader::Recording;

/// Size of the gathered values of a group of domains, in bytes. A group ends with the domain at which its values exceed
/// this size.
const GROUP_BYTES: u64 = 256 << 20;

/// A row-major 3x4 matrix.
pub(super) type Matrix3x4 = [f64; 12];

/// The values of a domain in every selected state.
#[derive(Debug, Default)]
pub(super) struct Track {
    /// r coordinates per state.
    pub(super) q: Vec<f32>,
    /// `world_from_domain`, in scene units relative to the scene's origin.
    pub(super) transforms: Vec<Matrix3x4>,
}

/// Which states are exported: their times and steps.
#[derive(Debug, Default)]
pub(super) struct StateTimes {
    /// Seconds since the first state, times the factor of the slow motion.
    pub(super) times: Vec<f64>,
    pub(super) steps: Vec<u64>,
    pub(super) runs: Vec<u64>,
    /// Per state of the recording: whether it is selected.
    pub(super) is_selected: Vec<bool>,
}

impl StateTimes {
    /// Selects all states.
    pub(super) fn read(recording: &Recording) -> Result<Self> {
        Self::select(recording, 1.0, |_, _| true)
    }

    /// Selects the last one of consecutive states whose times are equal as f32. All times are multiplied by `slow`.
    pub(super) fn read_increasing(recording: &Recording, slow: f64) -> Result<Self> {
        Self::select(recording, slow, |last, next| last as f32 != next as f32)
    }

    /// Selects the states whose time `is_distinct` from that of the next one.
    fn select(recording: &Recording, slow: f64, is_distinct: impl Fn(f64, f64) -> bool) -> Result<Self> {
        let mut selected = Self::default();
        let mut states = recording.states(0, u64::MAX)?;
        while let Some(recorded) = states.next()? {
            let time = recorded.time as f64 * 1e-9 * slow;
            if selected.times.last().is_some_and(|last| !is_distinct(*last, time)) {
                selected.pop();
            }
            selected.times.push(time);
            selected.steps.push(recorded.state.step.number);
            selected.runs.push(recorded.state.step.run);
            selected.is_selected.push(true);
        }
        match selected.count() {
            0 => Err(recording.invalid("topic states", "at least one state", "none")),
            _ => Ok(selected),
        }
    }

    fn pop(&mut self) {
        self.times.pop();
        self.steps.pop();
        self.runs.pop();
        if let Some(last) = self.is_selected.last_mut() {
            *last = false;
        }
    }

    pub(super) const fn count(&self) -> usize {
        self.times.len()
    }
}

/// Gathers the tracks of all domains, and passes each to `process` in the order of the domains. The recording is read
/// once per group.
pub(super) fn for_each_track(
    recording: &Recording,
    selected: &StateTimes,
    mut process: impl FnMut(usize, Track) -> Result<()>,
) -> Result<()> {
    let domains = &recording.description().domains;
    let mut start = 0;
    while start < domains.len() {
        let (mut end, mut bytes) = (start, 0);
        while end < domains.len() && (end == start || bytes <= GROUP_BYTES) {
            let state_bytes = size_of::<f32>() * domains[end].rank + size_of::<Matrix3x4>();
            bytes += (state_bytes * selected.count()) as u64;
            end += 1;
        }
        for (domain, track) in (start..end).zip(gather(recording, selected, start..end)?) {
            process(domain, track)?;
        }
        start = end;
    }
    Ok(())
}

fn gather(recording: &Recording, selected: &StateTimes, domains: Range<usize>) -> Result<Vec<Track>> {
    let info = &recording.description().info;
    let scene_origin = |axis: usize| info.origin.get(axis).copied().unwrap_or(0.0);
    let mut tracks: Vec<Track> = domains.clone().map(|_| Track::default()).collect();
    let mut states = recording.states(0, u64::MAX)?;
    for is_selected in &selected.is_selected {
        let Some(recorded) = states.next()? else { break };
        if !*is_selected {
            continue;
        }
        for (domain, track) in domains.clone().zip(&mut tracks) {
            let state = &recorded.state;
            track.q.extend_from_slice(state.q(domain).unwrap_or_default());
            let mut transform = state.transform(domain).unwrap_or_default().map(f64::from);
            let origin = state.origin(domain).unwrap_or_default();
            for axis in 0..3 {
                transform[4 * axis + 3] += (origin[axis] - scene_origin(axis)) / info.unit;
            }
            track.transforms.push(transform);
        }
    }
    Ok(tracks)
}
