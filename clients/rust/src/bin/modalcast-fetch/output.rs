//! Output of the commands: summaries as text or as one line of JSON on standard output, and progress on standard error.

use std::collections::BTreeSet;
use std::time::Instant;

use indicatif::{ProgressBar, ProgressStyle};
use modalcast_client::{Client, Frame, FrameLook, Result, SceneInfo, SceneList, StageSamples, StageTimes, StepId, v1};
use serde_json::{Value, json};

use crate::cli::SceneOptions;

/// Step, size and stage times of one received frame or vertex set.
pub(crate) struct ReceivedReply<'a> {
    pub(crate) step_id: StepId,
    pub(crate) bytes: u64,
    /// Number of steps skipped since the previous reply.
    pub(crate) skipped: u64,
    pub(crate) stages: &'a StageTimes,
}

/// Arrival times of the first and the last reply.
#[derive(Clone, Copy)]
struct ReplyTimes {
    first: Instant,
    last: Instant,
}

/// Totals of the received frames or vertices.
pub(crate) struct Summary {
    start: Instant,
    /// `None` before the first reply.
    reply_times: Option<ReplyTimes>,
    /// Step number of each reply.
    step_numbers: Vec<u64>,
    /// Run of each reply: the number of the writer that sent its step.
    run_numbers: Vec<u64>,
    bytes: u64,
    skipped: u64,
    stages: StageSamples,
    /// The different looks of color frames, as text.
    looks: BTreeSet<String>,
    /// The largest distance of a vertex below the ground in meters.
    below_ground: f64,
    /// Number of frames whose camera was moved, because no domain was in the view that frames the rest bounds.
    reframed_count: u64,
}

impl Summary {
    pub(crate) fn new() -> Self {
        Self {
            start: Instant::now(),
            reply_times: None,
            step_numbers: vec![],
            run_numbers: vec![],
            bytes: 0,
            skipped: 0,
            stages: StageSamples::default(),
            looks: BTreeSet::new(),
            below_ground: 0.0,
            reframed_count: 0,
        }
    }

    /// Counts one reply.
    pub(crate) fn add(&mut self, reply: &ReceivedReply<'_>) {
        let now = Instant::now();
        self.reply_times = Some(ReplyTimes { first: self.reply_times.map_or(now, |times| times.first), last: now });
        self.run_numbers.push(reply.step_id.run);
        self.step_numbers.push(reply.step_id.number);
        self.bytes += reply.bytes;
        self.skipped += reply.skipped;
        self.stages.add(reply.stages);
    }

    /// Adds the look of a frame, how far its vertices lie below the ground, and whether its camera was moved.
    pub(crate) fn add_frame_info(&mut self, frame: &Frame) {
        self.looks.extend(frame.look.as_ref().map(FrameLook::to_string));
        self.below_ground = self.below_ground.max(frame.below_ground);
        self.reframed_count += u64::from(frame.reframed);
    }

    /// Replies per second from the first to the last reply; 0 for fewer than two replies.
    fn replies_per_second(&self) -> f64 {
        let seconds = self.reply_times.map_or(0.0, |times| (times.last - times.first).as_secs_f64());
        if seconds > 0.0 { (self.step_numbers.len() - 1) as f64 / seconds } else { 0.0 }
    }

    /// Prints the summary. In the JSON, `reply_noun` is the key of the number of replies, and `steps` lists their step
    /// numbers. `origin` is the world position of the vertex origin in meters; `None` for frames.
    pub(crate) fn print(self, reply_noun: &str, out: &std::path::Path, origin: Option<Vec<f64>>, as_json: bool) {
        let rate = self.replies_per_second();
        let medians = self.stages.medians();
        let elapsed = self.start.elapsed().as_secs_f64();
        let count = self.step_numbers.len();
        if as_json {
            let mut summary = json!({
                reply_noun: count, "out": out.display().to_string(),
                "steps": self.step_numbers, "runs": self.run_numbers,
                "bytes": self.bytes, "skipped": self.skipped, "elapsed_s": elapsed,
                "per_second": rate, "stages_ms": medians,
            });
            if let Some(origin) = origin {
                summary["origin"] = json!(origin);
            }
            if !self.looks.is_empty() {
                (summary["looks"], summary["below_ground"]) = (json!(self.looks), json!(self.below_ground));
                summary["reframed"] = json!(self.reframed_count);
            }
            println!("{summary}");
            return;
        }
        let (bytes, skipped) = (self.bytes, self.skipped);
        println!(
            "{count} {reply_noun}, {bytes} bytes, {elapsed:.2} s ({rate:.1}/s), {skipped} skipped: {}",
            out.display()
        );
        for (stage, milliseconds) in medians {
            println!("  {stage:8} {milliseconds:8.3} ms (median)");
        }
        self.looks.iter().for_each(|look| println!("  look     {look}"));
        if self.reframed_count > 0 {
            let count = self.reframed_count;
            println!("  remark   no domain is in the view of the rest state: {count} frames show them where they are");
        }
        if self.below_ground > 0.0 {
            println!("  remark   vertices lie up to {:.4} m below the ground", self.below_ground);
        }
    }
}

/// A progress bar on standard error; hidden unless standard error is a terminal.
pub(crate) fn create_progress_bar(count: u64, reply_noun: &'static str) -> ProgressBar {
    let style = ProgressStyle::with_template("{msg} [{bar:32}] {pos}/{len} {per_sec} eta {eta}");
    ProgressBar::new(count).with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar())).with_message(reply_noun)
}

/// Opens the scene if `--open` is given, and prints its remarks on standard error. Returns its name on the server.
pub(crate) async fn open_scene(client: &Client, options: &SceneOptions) -> Result<String> {
    match &options.open {
        None => Ok(options.scene.clone()),
        Some(source) => {
            let info = client.open_scene(source, &options.scene).await?;
            info.remarks.iter().for_each(|remark| eprintln!("modalcast-fetch: {}: {remark}", info.scene));
            Ok(info.scene)
        }
    }
}

/// Prints backend, renderer and limits of the server.
pub(crate) async fn print_info(client: &Client, as_json: bool) -> Result<()> {
    let info = client.server_info().await?;
    let limits = &info.limits;
    if as_json {
        let limits = json!({
            "message_bytes": limits.message_bytes, "frame_side": limits.frame_side, "scenes": limits.scenes,
            "window": limits.window, "upload_bytes": limits.upload_bytes, "deadline_ms": limits.deadline_ms,
        });
        let features: Vec<_> = info.features.iter().map(v1::Feature::as_str_name).collect();
        let summary = json!({
            "version": info.version, "protocol_version": v1::PROTOCOL_VERSION, "features": features,
            "backend": info.backend, "device": info.device, "renderer": info.renderer,
            "software": info.is_software_renderer, "limits": limits,
        });
        println!("{summary}");
        return Ok(());
    }
    let renderer_kind = if info.is_software_renderer { "software" } else { "hardware" };
    println!("modalcast {}\nbackend   {} ({})", info.version, info.backend, info.device);
    println!("renderer  {} ({renderer_kind})", info.renderer);
    println!("message   at most {} bytes", limits.message_bytes);
    println!("frame     at most {} pixels a side", limits.frame_side);
    println!("scenes    at most {}", limits.scenes);
    println!("window    at most {} steps", limits.window);
    println!("upload    at most {} bytes", limits.upload_bytes);
    println!("deadline  {} ms by default", limits.deadline_ms);
    for feature in &info.features {
        println!("feature   {}", feature.as_str_name());
    }
    Ok(())
}

/// Prints the open scenes and the available sources.
pub(crate) async fn print_list(client: &Client, as_json: bool) -> Result<()> {
    let SceneList { scenes, sources } = client.list_scenes().await?;
    if as_json {
        let scenes: Vec<_> = scenes.iter().map(scene_json).collect();
        println!("{}", json!({ "scenes": scenes, "sources": sources }));
        return Ok(());
    }
    for scene in scenes {
        let last_step =
            scene.last_step.map_or("no step yet".into(), |step| format!("step {} of run {}", step.number, step.run));
        let writer = if scene.writer.is_empty() { "not driven".into() } else { format!("driven by {}", scene.writer) };
        let SceneInfo { scene: name, source, domains, vertices, triangles, coordinates, streams, .. } = scene;
        println!(
            "{name} ({source}): {domains} domains, {vertices} vertices, {triangles} triangles, {coordinates} \
             coordinates, {last_step}, {writer}, {streams} streams"
        );
    }
    for source in sources {
        println!("available source: {source}");
    }
    Ok(())
}

fn scene_json(scene: &SceneInfo) -> Value {
    let last_step = scene.last_step.map(|step| json!({ "run": step.run, "number": step.number, "time": step.time }));
    json!({
        "scene": scene.scene, "source": scene.source, "domains": scene.domains, "vertices": scene.vertices,
        "corners": scene.corners, "triangles": scene.triangles, "coordinates": scene.coordinates, "up": scene.up,
        "unit": scene.unit, "origin": scene.origin, "bounds": scene.bounds, "last_step": last_step,
        "remarks": scene.remarks, "owner": scene.owner, "shared_with": scene.shared_with, "writer": scene.writer,
        "streams": scene.streams,
    })
}

/// Prints a link to the viewer at each of the [`page_urls`].
pub(crate) fn print_links(server: &str, link: &v1::CreateViewerLinkResponse, scene: Option<&str>) {
    let separator = if link.url_path.contains('#') { '&' } else { '#' };
    let scene = scene.map(|scene| format!("{separator}scene={scene}")).unwrap_or_default();
    for url in page_urls(server, link) {
        println!("{url}{}{scene}", link.url_path);
    }
}

/// The URLs of the page: all that the server names if it is on this machine; else its public URL or, without one, the
/// address of this client.
fn page_urls(server: &str, link: &v1::CreateViewerLinkResponse) -> Vec<String> {
    let has_scheme = server.contains("://") || server.starts_with("unix:");
    let server = if has_scheme { server.to_owned() } else { format!("http://{server}") };
    let is_here =
        ["unix:", "http://127.", "http://localhost", "http://[::1]"].iter().any(|start| server.starts_with(start));
    match (is_here && !link.urls.is_empty(), link.public_url.is_empty()) {
        (true, _) => link.urls.clone(),
        (false, false) => vec![link.public_url.clone()],
        (false, true) => vec![server.trim_end_matches('/').to_owned()],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_begin_with_urls_that_browsers_reach() {
        let urls = vec!["https://127.0.0.1:1".to_owned(), "https://gpu:1".to_owned()];
        let link = v1::CreateViewerLinkResponse { urls: urls.clone(), ..Default::default() };
        for server in ["127.0.0.1:1", "localhost:1", "http://127.0.0.1:1", "unix:/run/1.sock"] {
            assert_eq!(page_urls(server, &link), urls, "{server}");
        }
        assert_eq!(page_urls("gpu:1", &link), ["http://gpu:1"]);
        assert_eq!(page_urls("https://gpu:1/", &link), ["https://gpu:1"]);
        let public = v1::CreateViewerLinkResponse { public_url: "https://lab.example/render".into(), ..link };
        assert_eq!(page_urls("https://gpu:1", &public), ["https://lab.example/render"]);
    }

    #[test]
    fn rate_excludes_the_wait_for_the_first_reply() {
        let mut summary = Summary::new();
        assert_eq!(summary.replies_per_second(), 0.0);
        for number in 0..3 {
            let step_id = StepId { run: 1, number, time: 0.0 };
            summary.add(&ReceivedReply { step_id, bytes: 8, skipped: 0, stages: &vec![] });
        }
        let start = summary.start;
        let time = |seconds| start + std::time::Duration::from_secs(seconds);
        // Two intervals between three replies take 4 s.
        summary.reply_times = Some(ReplyTimes { first: time(60), last: time(64) });
        assert_eq!(summary.replies_per_second(), 0.5);
    }
}
