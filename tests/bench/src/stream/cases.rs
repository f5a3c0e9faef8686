//! The cases of the report. Cases of one scene follow each other, because they share a server.

use super::contention::OtherWork;
use super::delay::DelayedStream;
use super::peers::viewer::Content;
use super::rates::Viewers;
use super::session::{SceneSource, ServerBackend};
use super::{QUICK_DIVISOR, StreamReportOptions};
use crate::thesis::PLANTS;
use crate::workloads::Size;

/// One case.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Case {
    /// The name states the full sizes; a quick report has smaller pictures.
    pub(super) name: &'static str,
    pub(super) scene: SceneSource,
    pub(super) backend: ServerBackend,
    pub(super) measurement: Measurement,
}

/// What a case measures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Measurement {
    /// Rate of viewers, or of steps without viewers.
    Rate(Option<Viewers>),
    /// Time from a step to its frame, over this number of steps.
    FrameLatency(Content, u64),
    /// Time from a step to its acknowledgment, over this number of steps.
    AcknowledgmentLatency(u64),
    /// Vertices over the server's sockets and in shared memory, beside a plain TCP connection.
    Socket,
    /// Waits while the server works for another client.
    Contention(OtherWork),
    /// Rate over a connection with a long round trip.
    Delay(DelayedStream),
    VertexEncodings,
    PictureEncodings(Content),
    /// Rates beside those of a Python program, with pictures of this width and height.
    Afternoon([u32; 2]),
    /// Rate of one viewer of a plant, with the columns of tables 4.5 to 4.7 of the thesis.
    Plant(Content),
}

impl Case {
    const fn new(name: &'static str, scene: SceneSource, measurement: Measurement) -> Self {
        Self { name, scene, backend: ServerBackend::Default, measurement }
    }
}

/// The contents that several cases have.
struct Contents {
    png_1080p: Content,
    png_720p: Content,
    png_360p: Content,
    raw_1080p: Content,
    size_1080p: [u32; 2],
}

impl Contents {
    fn of(size: Size) -> Self {
        let divisor = match size {
            Size::Full => 1,
            Size::Quick => QUICK_DIVISOR,
        };
        let png = |width, height| Content::Png { width: width / divisor, height: height / divisor };
        Self {
            png_1080p: png(1920, 1080),
            png_720p: png(1280, 720),
            png_360p: png(640, 360),
            raw_1080p: Content::Rgba { width: 1920 / divisor, height: 1080 / divisor },
            size_1080p: [1920 / divisor, 1080 / divisor],
        }
    }
}

/// Steps of the latency of frames and of acknowledgments.
fn latency_steps(options: &StreamReportOptions) -> [u64; 2] {
    let defaults = match options.size {
        Size::Full => [10_000, 2_000],
        Size::Quick => [200, 200],
    };
    options.latency_steps.map_or(defaults, |steps| [steps; 2])
}

/// All cases. Scenes of a folder are included if the options name the folder.
pub(super) fn all(options: &StreamReportOptions) -> Vec<Case> {
    let contents = Contents::of(options.size);
    let mut cases = tree_cases(&contents, latency_steps(options));
    if options.scenes.is_some() {
        cases.extend(repository_cases(&contents, latency_steps(options)));
    }
    cases.push(Case::new("grid-socket", SceneSource::Grid, Measurement::Socket));
    cases.extend(plant_cases(contents.png_1080p, options.scenes.is_some()));
    cases
}

fn tree_cases(contents: &Contents, [frames, acknowledgments]: [u64; 2]) -> Vec<Case> {
    let rate = |content, count, views| Measurement::Rate(Some(Viewers { content, count, views }));
    let delayed_replies = |content| Measurement::Delay(DelayedStream::Replies(content));
    let cases = [
        ("tree-png-1080p", rate(contents.png_1080p, 1, 1)),
        ("tree-png-720p", rate(contents.png_720p, 1, 1)),
        ("tree-png-360p", rate(contents.png_360p, 1, 1)),
        ("tree-raw-1080p", rate(contents.raw_1080p, 1, 1)),
        ("tree-png-360p-8-viewers", rate(contents.png_360p, 8, 1)),
        ("tree-png-360p-32-viewers", rate(contents.png_360p, 32, 1)),
        ("tree-png-360p-32-viewers-4-views", rate(contents.png_360p, 32, 4)),
        ("tree-vertices", rate(Content::Positions, 1, 1)),
        ("tree-vertices-compact", rate(Content::CompactPositions, 1, 1)),
        ("tree-steps", Measurement::Rate(None)),
        ("tree-acknowledgments", Measurement::AcknowledgmentLatency(acknowledgments)),
        ("tree-latency", Measurement::FrameLatency(contents.png_1080p, frames)),
        ("tree-socket", Measurement::Socket),
        ("tree-waits-loads", Measurement::Contention(OtherWork::Loads)),
        ("tree-waits-large-frames", Measurement::Contention(OtherWork::LargeFrames)),
        ("tree-delay-steps", Measurement::Delay(DelayedStream::Steps)),
        ("tree-delay-vertices", delayed_replies(Content::Positions)),
        ("tree-delay-png-1080p", delayed_replies(contents.png_1080p)),
        ("tree-vertex-encodings", Measurement::VertexEncodings),
        ("tree-picture-encodings", Measurement::PictureEncodings(contents.raw_1080p)),
        ("tree-afternoon", Measurement::Afternoon(contents.size_1080p)),
    ];
    cases.map(|(name, measurement)| Case::new(name, SceneSource::Tree, measurement)).into()
}

fn repository_cases(contents: &Contents, [frames, _]: [u64; 2]) -> Vec<Case> {
    const ALMOND: SceneSource = SceneSource::ALMOND;
    const BRIDGE: SceneSource = SceneSource::BRIDGE;
    let rate = |content| Measurement::Rate(Some(Viewers::one(content)));
    let cases = [
        ("almond-png-1080p", ALMOND, rate(contents.png_1080p)),
        ("almond-vertices", ALMOND, rate(Content::Positions)),
        ("almond-vertices-compact", ALMOND, rate(Content::CompactPositions)),
        ("almond-steps", ALMOND, Measurement::Rate(None)),
        ("almond-latency", ALMOND, Measurement::FrameLatency(contents.png_1080p, frames)),
        ("almond-vertex-encodings", ALMOND, Measurement::VertexEncodings),
        ("almond-picture-encodings", ALMOND, Measurement::PictureEncodings(contents.raw_1080p)),
        ("almond-afternoon", ALMOND, Measurement::Afternoon(contents.size_1080p)),
        ("bridge-png-720p", BRIDGE, rate(contents.png_720p)),
        ("bridge-vertices", BRIDGE, rate(Content::Positions)),
        ("bridge-steps", BRIDGE, Measurement::Rate(None)),
        ("bridge-delay-steps", BRIDGE, Measurement::Delay(DelayedStream::Steps)),
    ];
    cases.map(|(name, scene, measurement)| Case::new(name, scene, measurement)).into()
}

/// The names of the cases of a plant, by the default backend and by the CPU.
macro_rules! plant_names {
    ($($name:literal),*) => { [$([concat!($name, "-png-1080p"), concat!($name, "-png-1080p-cpu")]),*] };
}

/// Cases of the generated plants, in the order of table 4.5.
const SKELETON_CASES: [[&str; 2]; PLANTS.len()] = plant_names!(
    "plant-1", "plant-2", "plant-3", "plant-4", "plant-5", "plant-6", "plant-7", "plant-8", "plant-9", "plant-10",
    "plant-11", "plant-12"
);

/// Cases of the plants of a folder.
const REAL_PLANTS: [([&str; 2], SceneSource); 2] = {
    let [almond, bean] = plant_names!("plant-almond", "plant-bean");
    [(almond, SceneSource::ALMOND), (bean, SceneSource::BEAN)]
};

fn plant_cases(content: Content, has_folder: bool) -> Vec<Case> {
    let skeletons = SKELETON_CASES.iter().enumerate().map(|(index, names)| (*names, SceneSource::Skeleton(index)));
    let real_plants = REAL_PLANTS.into_iter().filter(|_| has_folder);
    let pair = |([by_default, by_cpu], scene): ([&'static str; 2], SceneSource)| {
        let case = Case::new(by_default, scene, Measurement::Plant(content));
        [case, Case { name: by_cpu, backend: ServerBackend::Cpu, ..case }]
    };
    real_plants.chain(skeletons).flat_map(pair).collect()
}

/// Lines that describe the cases, for the help text.
pub(crate) const CASE_HELP: &str = "Cases:
  tree-png-1080p, tree-png-720p, tree-png-360p, tree-raw-1080p, tree-vertices, tree-vertices-compact
                 frames or positions per second at one viewer
  tree-png-360p-8-viewers, -32-viewers, -32-viewers-4-views
                 frames per second at the slowest viewer
  tree-steps, tree-acknowledgments
                 steps per second without viewers, and the time from a step to its acknowledgment
  tree-latency   time from a step to its PNG of 1920x1080, with a step every 16.7 ms
  tree-socket, grid-socket
                 positions over TCP, a Unix socket and in shared memory, beside a plain TCP connection; the grid has
                 1.5 M vertices
  tree-waits-loads, tree-waits-large-frames
                 time from a step to its frame while another client loads scenes (with --scenes also the almond
                 and the bridge), or draws frames of 8192x8192
  tree-delay-steps, tree-delay-vertices, tree-delay-png-1080p
                 rates over a connection with a round trip of 50 ms
  tree-vertex-encodings, tree-picture-encodings
                 bytes, times and errors of encodings
  tree-afternoon
                 rates beside those of a Python program that draws the same scene (needs moderngl, pyzmq,
                 opencv-python-headless and numpy in MODALCAST_PYTHON; uses cupy on a GPU)
  almond-*, bridge-*
                 scenes of --scenes: png, vertices, steps, of the almond also latency, encodings and the
                 Python program, and of the bridge also steps over a round trip of 50 ms
  plant-1-png-1080p .. plant-12-png-1080p, plant-almond-png-1080p, plant-bean-png-1080p, each also with -cpu
                 generated plants with the counts of table 4.5 of the thesis, and the almond and the bean of
                 --scenes: deformation, drawing, simulation, and frames per second with and without the
                 simulation; -cpu is the same server with --backend cpu";

#[cfg(test)]
mod tests {
    use super::super::skeletons;
    use super::*;

    #[test]
    fn names_are_unique_and_cases_of_a_scene_follow_each_other() {
        let options = StreamReportOptions {
            scenes: Some("data".into()),
            cases: vec![],
            steps: 1,
            latency_steps: None,
            repeat: 1,
            size: Size::Full,
        };
        let cases = all(&options);
        for (index, case) in cases.iter().enumerate() {
            assert!(cases[..index].iter().all(|other| other.name != case.name), "{}", case.name);
        }
        let mut scenes: Vec<&str> = cases.iter().map(|case| case.scene.name()).collect();
        scenes.dedup();
        assert_eq!(scenes[..6], ["tree", "plants/almond", "vega/simpleBridge", "grid", "plants/almond", "plants/bean"]);
        assert_eq!(scenes[6..], skeletons::FILES);
        let without_folder = all(&StreamReportOptions { scenes: None, ..options });
        assert!(without_folder.iter().all(|case| !matches!(case.scene, SceneSource::Repository(_))));
    }
}
