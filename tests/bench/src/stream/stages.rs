//! The rate of each stage between the physics process and the viewers, and the slowest stage.
//!
//! The rate of a stage is the number of steps per second that it could process if no other stage limited it. For a
//! stage of the server, it is the number of threads that run the stage in parallel, divided by its median time per
//! step. The drawing time of a step includes all its views: it is the sum over the distinct views. The time that a step
//! waits in the step queue is not a stage.

use std::collections::BTreeMap;

use modalcast_client::ServerInfo;
use serde::Serialize;

use super::peers::viewer::Content;
use modalcast::frame::PngLayout;

/// The name of the physics process among the stages.
pub(super) const PHYSICS_STAGE: &str = "physics process";

/// The stages that run one after the other on the GPU, or on the CPU if the machine has no GPU. `switch` is the change of
/// the GPU from CUDA to OpenGL.
const DEVICE_STAGES: [&str; 5] = ["deform", "upload", "switch", "shadow", "draw"];

/// Stages that share a resource are reported as one group. A stage that takes less than this fraction of the group's
/// time is not named.
const MIN_NAMED_FRACTION: f64 = 0.05;

/// One stage, or several that share a resource.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StageRate {
    /// The stages: `draw and shadow`.
    pub stages: String,
    /// Time per step in milliseconds.
    pub ms: f64,
    /// What the stage runs on: `one GPU`.
    pub resource: String,
    /// Number of steps that the resource processes at a time.
    pub parallel: usize,
    /// `parallel` divided by the time per step.
    pub per_second: f64,
}

impl StageRate {
    fn new(stages: impl Into<String>, ms: f64, resource: impl Into<String>, parallel: usize) -> Self {
        let per_second = parallel as f64 * 1e3 / ms;
        Self { stages: stages.into(), ms, resource: resource.into(), parallel, per_second }
    }

    /// The stage with its time and its resource in words.
    pub fn line(&self) -> String {
        format!("{}: {:.3} ms of {}", self.stages, self.ms, self.resource)
    }
}

/// Measurements of one benchmark case, from which [`Self::rates`] computes the rate of each stage.
pub(super) struct StageInputs<'a> {
    pub(super) server: &'a ServerInfo,
    /// Threads of the machine.
    pub(super) threads: usize,
    /// Content of the replies and number of viewers; `None` for steps without viewers.
    pub(super) viewers: Option<(Content, usize)>,
    /// Median time of each stage in milliseconds, for each distinct view; of pictures, with one step in flight. Without
    /// viewers: from the acknowledgments.
    pub(super) views: &'a [BTreeMap<String, f32>],
    pub(super) physics_per_second: f64,
    /// Replies per second over a plain TCP connection, if there are viewers.
    pub(super) socket_per_second: Option<f64>,
}

impl StageInputs<'_> {
    /// The rates of all stages, the slowest first.
    pub(super) fn rates(&self) -> Vec<StageRate> {
        let mut rates = vec![StageRate::new(
            PHYSICS_STAGE,
            1e3 / self.physics_per_second,
            "one process that computes and sends steps",
            1,
        )];
        rates.extend(self.max_over_views("parse").map(|ms| StageRate::new("parse", ms, "one thread", 1)));
        rates.extend(self.device_rate());
        rates.extend(self.sum_over_views("read").map(|ms| StageRate::new("read", ms, "one readback at a time", 1)));
        rates.extend(self.max_over_views("copy").map(|ms| StageRate::new("copy", ms, "one readback at a time", 1)));
        if let Some((content, viewers)) = self.viewers {
            rates.extend(self.encode_rate(content, viewers));
        }
        let transfer = |rate| StageRate::new("transfer", 1e3 / rate, "one TCP connection per viewer", 1);
        rates.extend(self.socket_per_second.map(transfer));
        rates.retain(|rate| rate.per_second.is_finite());
        rates.sort_by(|a, b| a.per_second.total_cmp(&b.per_second));
        rates
    }

    /// The group of the stages on the device. A step is deformed once for all views.
    fn device_rate(&self) -> Option<StageRate> {
        let stage_ms = |stage: &'static str| match stage {
            "deform" => self.max_over_views(stage),
            _ => self.sum_over_views(stage),
        };
        let mut times: Vec<(&str, f64)> =
            DEVICE_STAGES.iter().filter_map(|stage| Some((*stage, stage_ms(stage)?))).collect();
        let total_ms: f64 = times.iter().map(|(_, ms)| ms).sum();
        times.retain(|(_, ms)| *ms >= MIN_NAMED_FRACTION * total_ms);
        times.sort_by(|a, b| b.1.total_cmp(&a.1));
        let names: Vec<&str> = times.iter().map(|(stage, _)| *stage).collect();
        let draws = self.viewers.is_some_and(|(content, _)| content.is_picture());
        let is_on_cpu = if draws { self.server.is_software_renderer } else { self.server.backend != "cuda" };
        let resource = if is_on_cpu { "the CPU" } else { "one GPU" };
        (total_ms > 0.0).then(|| StageRate::new(join_words(&names), total_ms, resource, 1))
    }

    /// Each distinct frame is encoded once, on as many of the server's encoder threads as a picture has strips. There
    /// is one such thread per thread of the machine. Vertices are packed for each viewer, one step at a time.
    fn encode_rate(&self, content: Content, viewers: usize) -> Option<StageRate> {
        let threads = self.threads;
        let is_png = matches!(content, Content::Png { .. });
        let (ms, resource, parallel) = match content.is_picture() {
            true => {
                let strips = strip_count(content);
                let resource = format!("{} of {threads} encoder threads", strips.min(threads));
                (self.sum_over_views("encode")?, resource, (threads / strips).max(1))
            }
            false => {
                let waves = viewers.div_ceil(threads) as f64;
                (waves * self.max_over_views("encode")?, "one thread per viewer".to_owned(), 1)
            }
        };
        Some(StageRate::new(if is_png { "PNG encoding" } else { "packing" }, ms, resource, parallel))
    }

    fn sum_over_views(&self, stage: &str) -> Option<f64> {
        let times: Vec<f64> = self.times(stage).collect();
        (!times.is_empty()).then(|| times.iter().sum())
    }

    fn max_over_views(&self, stage: &str) -> Option<f64> {
        self.times(stage).reduce(f64::max)
    }

    fn times(&self, stage: &str) -> impl Iterator<Item = f64> {
        self.views.iter().filter_map(move |view| view.get(stage)).map(|ms| f64::from(*ms))
    }
}

/// Number of parts of a picture that are encoded in parallel.
fn strip_count(content: Content) -> usize {
    match content {
        Content::Png { width, height } => PngLayout::opaque(width, height).map_or(1, |layout| layout.strip_count()),
        _ => 1,
    }
}

/// Joins words: `a, b and c`.
fn join_words(words: &[&str]) -> String {
    match words {
        [] => String::new(),
        [word] => (*word).to_owned(),
        [first @ .., last] => format!("{} and {last}", first.join(", ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn server(software: bool) -> ServerInfo {
        ServerInfo {
            version: "1".into(),
            backend: if software { "cpu" } else { "cuda" }.into(),
            device: String::new(),
            renderer: String::new(),
            is_software_renderer: software,
            features: vec![],
            limits: Default::default(),
        }
    }

    fn view(times: &[(&str, f32)]) -> BTreeMap<String, f32> {
        times.iter().map(|(stage, ms)| ((*stage).to_owned(), *ms)).collect()
    }

    fn inputs<'a>(
        server: &'a ServerInfo,
        views: &'a [BTreeMap<String, f32>],
        viewers: Option<(Content, usize)>,
    ) -> StageInputs<'a> {
        StageInputs {
            server,
            threads: 16,
            viewers,
            views,
            physics_per_second: 500.0,
            socket_per_second: viewers.map(|_| 2000.0),
        }
    }

    #[test]
    fn slowest_stage_is_first_and_described_in_words() {
        let views = [view(&[("deform", 0.05), ("shadow", 1.3), ("draw", 1.4), ("encode", 24.0), ("queue", 90.0)])];
        let server = server(false);
        let png = Content::Png { width: 8, height: 8 };
        let rates = inputs(&server, &views, Some((png, 8))).rates();
        assert_eq!(rates[0].line(), "draw and shadow: 2.750 ms of one GPU");
        let rate_of = |stages: &str| rates.iter().find(|rate| rate.stages == stages).map(|rate| rate.per_second);
        assert_eq!(rate_of("physics process"), Some(500.0));
        // 16 threads encode one frame each in 24 ms.
        assert_eq!((rate_of("PNG encoding"), rate_of("transfer")), (Some(16e3 / 24.0), Some(2000.0)));
        assert!(rates.iter().all(|rate| rate.stages != "queue"), "expected no rate of a wait");
    }

    #[test]
    fn views_add_drawing_and_encoding_but_not_deforming() {
        let times = view(&[("deform", 2.0), ("draw", 3.0), ("encode", 16.0)]);
        let views = [times.clone(), times];
        let server = server(true);
        let rates = inputs(&server, &views, Some((Content::Png { width: 8, height: 8 }, 4))).rates();
        let line_of = |stages: &str| rates.iter().find(|rate| rate.stages == stages).map(StageRate::line);
        assert_eq!(line_of("draw and deform"), Some("draw and deform: 8.000 ms of the CPU".into()));
        assert_eq!(line_of("PNG encoding"), Some("PNG encoding: 32.000 ms of 1 of 16 encoder threads".into()));
    }

    #[test]
    fn png_of_many_strips_occupies_all_threads() {
        let views = [view(&[("encode", 2.0)])];
        let server = server(false);
        let png = Content::Png { width: 1920, height: 1080 };
        let rates = inputs(&server, &views, Some((png, 1))).rates();
        let encode = rates.iter().find(|rate| rate.stages == "PNG encoding").expect("expected the stage");
        assert_eq!(
            (encode.line(), encode.per_second),
            ("PNG encoding: 2.000 ms of 16 of 16 encoder threads".into(), 500.0)
        );
    }

    #[test]
    fn steps_without_viewers_have_no_encoding_or_transfer() {
        let views = [view(&[("parse", 4.0), ("deform", 0.1)])];
        let server = server(false);
        let rates = inputs(&server, &views, None).rates();
        let names: Vec<&str> = rates.iter().map(|rate| rate.stages.as_str()).collect();
        assert_eq!(names, ["parse", "physics process", "deform"]);
        assert_eq!(join_words(&["a", "b", "c"]), "a, b and c");
    }
}
