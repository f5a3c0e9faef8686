//! `modalcast report render`: error of every rendering variant against brute-force references, and its run time.

use std::path::PathBuf;

use crate::render::workloads::RenderWorkload;
use crate::render::{self, RenderReport, RenderReportOptions, variants};
use crate::thesis::PLANTS;
use modalcast::cli::options::with_spinner;
use modalcast::cli::{Outcome, print_line};
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::FrameSize;

const LOADS: &str = "Loads:
  square       a square that floats over the ground
  shelf        a shelf just above the ground, from nearby
  panes        three translucent panes, listed in the wrong order
  images       panels with images of many sizes, each repeated
  tree, grove  the built-in tree, and four of them
  triangles-N  a rolling field of about N triangles with poles on it
  plants, plant-1 .. plant-12
               the plants of table 4.5 of the thesis, deformed and drawn: times and memory, no references

Examples:
  modalcast report render --out report
  modalcast report render --out report --quick
  modalcast report render --out report --load tree --load triangles-3000000 --size 1920x1080
  modalcast report render --out report --load square --variant 'variance 512*'
  modalcast report render --out report --raster --load triangles-3000000 --size 1920x1080
  modalcast report render --out figures --figures
  modalcast report render --out figures --figures --scene path/to/plant --size 1280x960";

/// Error against run time of the renderer: validates every variant against brute-force references, then times it.
///
/// Writes report.json, report.csv, report.md, report.svg, report.png and a folder pictures/ with the references and,
/// for every variant, a strip of rendered, reference and difference image. Exit code 1 when a variant exceeds its error
/// bounds.
#[derive(Debug, clap::Args)]
#[command(after_help = LOADS)]
pub(super) struct Args {
    /// Output folder; files of an earlier report there are replaced.
    #[arg(long)]
    out: PathBuf,
    /// A synthetic scene; repeatable. Default: all.
    #[arg(long = "load", value_name = "NAME")]
    loads: Vec<String>,
    /// Measure only this variant, or all variants with this prefix: "variance 512*"; repeatable.
    #[arg(long = "variant", value_name = "GLOB")]
    variants: Vec<String>,
    /// Size of still pictures in pixels [default: 640x360]; moving pictures have a quarter of it on each side. With
    /// --figures the size of single pictures [default: 640x480].
    #[arg(long)]
    size: Option<FrameSize>,
    /// Frames per median, at least 20 [default: 100, 20 with --quick].
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    replays: Option<u32>,
    /// Fewer variants (except those named in full), 16 samples per pixel and a smaller field, for machines without a
    /// GPU.
    #[arg(long)]
    quick: bool,
    /// Draw the figures of the thesis's chapter 4.2 from our own scenes; nothing is measured.
    #[arg(long, conflicts_with_all = ["loads", "variants", "replays", "quick"])]
    figures: bool,
    /// Measure only the CUDA rasterizer against OpenGL's bare passes, on the loads, a room and two triangles that fill
    /// the frame. Writes raster.json and raster.md. Needs an NVIDIA GPU.
    #[arg(long, conflicts_with_all = ["variants", "figures", "scenes"])]
    raster: bool,
    /// A scene of your own, a path to a model or a scene folder; repeatable. With --figures, also draws a picture of
    /// it. Without --figures, only its frame times are measured: times.json and a picture.
    #[arg(long = "scene", value_name = "PATH", conflicts_with_all = ["loads", "variants", "quick"])]
    scenes: Vec<String>,
}

/// Default sizes: of the report, and of the figures' pictures.
const USUAL: [FrameSize; 2] = [FrameSize { width: 640, height: 360 }, FrameSize { width: 640, height: 480 }];

/// Upper limit of a picture's side in pixels, because the references trace 16 to 64 samples per pixel.
const LARGEST: u32 = 4096;

pub(super) fn run(args: &Args) -> Outcome {
    if args.figures {
        return figures(args);
    }
    if !args.scenes.is_empty() {
        return timed(args);
    }
    let request = request(args)?;
    if args.raster {
        return rasters(args, &request);
    }
    let report = with_spinner("measuring", || render::render(&request, |what| tracing::info!(what, "measuring")))?;
    report.write(&args.out)?;
    lines(&report).into_iter().for_each(print_line);
    print_line(format!("written to {}", args.out.display()));
    Ok(report.passed())
}

fn rasters(args: &Args, request: &RenderReportOptions) -> Outcome {
    let rasters =
        with_spinner("measuring", || render::compare_rasterizers(request, |what| tracing::info!(what, "measuring")))?;
    rasters.write(&args.out)?;
    rasters.rows.iter().for_each(|row| print_line(row.line()));
    rasters.frames.iter().for_each(|row| print_line(row.line()));
    print_line(format!("written to {}", args.out.display()));
    Ok(rasters.passed())
}

fn figures(args: &Args) -> Outcome {
    let request = render::figures::FigureOptions { size: size(args, USUAL[1])?, scenes: args.scenes.clone() };
    let hear = |what: &str| tracing::info!(what, "drawing");
    let figures = with_spinner("drawing", || render::figures::draw_figures(&request, hear))?;
    figures.write(&args.out)?;
    for figure in &figures.figures {
        print_line(format!("{:<6}{:<36}{}", figure.name, figure.file, figure.captions.join("; ")));
    }
    print_line(format!("written to {}", args.out.display()));
    Ok(true)
}

fn timed(args: &Args) -> Outcome {
    let replays = args.replays.map_or(100, |replays| replays as usize);
    let request =
        render::frame_times::FrameTimeOptions { scenes: args.scenes.clone(), size: size(args, USUAL[0])?, replays };
    let timed = with_spinner("measuring", || {
        render::frame_times::time_scenes(&request, |what| tracing::info!(what, "timing"))
    })?;
    timed.write(&args.out)?;
    for scene in &timed.scenes {
        let frame = scene.passes.iter().find(|pass| pass.name == "frame").map_or(0.0, |pass| pass.timing.median_us);
        print_line(format!(
            "{:<24}frame {frame:>12.1} us, with its pixels {:>12.1} us",
            scene.name, scene.wall_clock.median_us
        ));
    }
    print_line(format!("written to {}", args.out.display()));
    Ok(true)
}

/// The requested or default size.
///
/// # Errors
/// `Invalid` when a side is not in 1 to [`LARGEST`].
fn size(args: &Args, usual: FrameSize) -> Result<render::Size> {
    let FrameSize { width, height } = args.size.unwrap_or(usual);
    match [width, height].iter().all(|side| (1..=LARGEST).contains(side)) {
        true => Ok(render::Size { width, height }),
        false => Err(invalid("size", format!("1 to {LARGEST} pixels a side"), FrameSize { width, height })),
    }
}

fn request(args: &Args) -> Result<RenderReportOptions> {
    let (mut loads, mut plants) = (Vec::new(), Vec::new());
    for name in &args.loads {
        match plants_named(name) {
            Some(named) => plants.extend(named),
            None => loads.push(RenderWorkload::from_name(name)?),
        }
    }
    if args.loads.is_empty() {
        (loads, plants) = (RenderWorkload::all(args.quick), (0..PLANTS.len()).collect());
    }
    let request = RenderReportOptions {
        loads,
        plants,
        variants: args.variants.clone(),
        size: size(args, USUAL[0])?,
        quick: args.quick,
        replays: args.replays.map_or(if args.quick { 20 } else { 100 }, |replays| replays as usize),
    };
    match request.selected_variants().is_empty() {
        false => Ok(request),
        true => {
            let names: Vec<String> = variants::all(false).into_iter().map(|variant| variant.name).collect();
            Err(invalid("variant", format!("one or more of: {}", names.join("; ")), args.variants.join("; ")))
        }
    }
}

/// Indices from 0 of the plants that a name selects; `None` when the name is no plant's.
fn plants_named(name: &str) -> Option<Vec<usize>> {
    if name == "plants" {
        return Some((0..PLANTS.len()).collect());
    }
    let number: usize = name.strip_prefix("plant-")?.parse().ok()?;
    (1..=PLANTS.len()).contains(&number).then(|| vec![number - 1])
}

fn lines(report: &RenderReport) -> Vec<String> {
    let head = ["frame us", "colour", "of aim", "light", "penumbra", "bleeding", "flicker", "passed"];
    let mut lines = vec![format!("{:<18}{:<40}{}", "load", "variant", head.map(|word| format!("{word:>10}")).concat())];
    for row in &report.rows {
        let show =
            |number: Option<f64>, digits: usize| number.map_or("-".into(), |number| format!("{number:.digits$}"));
        let cells = [
            show(row.median_us(), 1),
            show(Some(row.color_errors.mean), 3),
            show(Some(row.intended_color_errors.mean), 3),
            show(Some(row.intended_light_errors.all_pixels.mean), 4),
            show(Some(row.intended_light_errors.penumbra.mean), 4),
            show(row.intended_light_errors.umbra_visibility, 4),
            show(row.flicker.map(|flicker| flicker.mean), 3),
            match (row.passed, row.is_expected_to_fail) {
                (true, _) => "yes".into(),
                (false, true) => "as expected".into(),
                (false, false) => "NO".into(),
            },
        ];
        lines.push(format!("{:<18}{:<40}{}", row.load, row.name, cells.map(|cell| format!("{cell:>10}")).concat()));
    }
    lines.extend(report.readback.iter().map(|row| {
        let (load, none, all, loss) = (&row.load, row.unread_fps, row.ring_fps, row.ring_loss);
        format!("{load:<18}{none:.1} frames/s when none is read, {all:.1} when each is: {loss:.1} % fewer")
    }));
    for plant in &report.plants {
        lines.push(format!(
            "{:<18}{:<24}t_vbr {:>9.3} ms{:>10.1} FPS{:>9.1} MB  O_vbr {:>5.1} %",
            plant.load,
            plant.thesis.name,
            plant.vbr.median_us / 1e3,
            plant.fps,
            plant.bytes as f64 / 1e6,
            100.0 * plant.occupation
        ));
    }
    for minimal in &report.minimal_passes {
        let (depth, visibility) = (minimal.depth.median_us, minimal.visibility.median_us);
        lines.push(format!(
            "{:<18}map {}: bare depth {depth:.1} us, bare visibility {visibility:.1} us",
            minimal.load, minimal.map_size
        ));
        lines.extend([&minimal.without_culling, &minimal.with_scene_culling].map(|frame| {
            format!("{:<18}{} takes {:.1} us, {:.1} us beyond both", "", frame.name, frame.frame_us, frame.excess_us)
        }));
    }
    lines.extend(report.raster.iter().map(render::RasterComparison::line));
    lines.extend(report.failed.iter().map(|failed| format!("failed: {failed}")));
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    fn args() -> Args {
        let size = Some(FrameSize { width: 64, height: 48 });
        Args {
            out: PathBuf::from("out"),
            loads: vec![],
            variants: vec![],
            size,
            replays: None,
            quick: true,
            figures: false,
            raster: false,
            scenes: vec![],
        }
    }

    #[test]
    fn defaults_to_all_loads_and_rejects_bad_names_and_sizes() {
        let all = request(&args()).expect("fits");
        assert_eq!((all.loads.len(), all.plants.len(), all.replays), (RenderWorkload::all(true).len(), 12, 20));
        let plants = Args { loads: ["plant-3", "square", "plants"].map(String::from).to_vec(), ..args() };
        let plants = request(&plants).expect("fits");
        assert_eq!((plants.loads.len(), plants.plants.len(), plants.plants[0]), (1, 13, 2));
        let named = Args { loads: vec!["square".into(), "triangles-10".into()], replays: Some(7), ..args() };
        assert_eq!(request(&named).expect("fits").loads, [RenderWorkload::Square, RenderWorkload::Triangles(10)]);
        // A quick run also includes the frame that the bare passes are compared with, if it is named.
        let variants = ["variance 4096, blur 1.5", "culling*"].map(String::from).to_vec();
        let named = request(&Args { variants, ..args() }).expect("fits").selected_variants();
        let names: Vec<&str> = named.iter().map(|variant| variant.name.as_str()).collect();
        assert_eq!(names, ["variance 4096, blur 1.5", "culling none", "culling triangles", "culling depth"]);
        assert_eq!(request(&args()).expect("fits").selected_variants().len(), variants::all(true).len());
        for wrong in [
            Args { loads: vec!["cube".into()], ..args() },
            Args { loads: vec!["plant-13".into()], ..args() },
            Args { variants: vec!["varience*".into()], ..args() },
            Args { size: Some(FrameSize { width: 0, height: 5 }), ..args() },
            Args { size: Some(FrameSize { width: 5, height: 5000 }), ..args() },
        ] {
            assert!(request(&wrong).is_err(), "{wrong:?}");
        }
    }
}
