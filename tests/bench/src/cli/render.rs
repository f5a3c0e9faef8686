//! `modalcast report render`: error of every rendering variant against brute-force references, and its run time.

use std::path::PathBuf;

use crate::render::workloads::RenderWorkload;
use crate::render::{self, RenderProgress, RenderReport, RenderReportOptions, variants};
use crate::thesis::PLANTS;
use modalcast::cli::options::with_spinner;
use modalcast::cli::{Completion, Outcome, print_line};
use modalcast_model::backend_settings::RasterFacts;
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::FrameSize;

const WORKLOAD_HELP: &str = "Loads:
  square       a square that floats over the ground
  shelf        a shelf just above the ground, from nearby
  layers       the shadow of three sheets above each other whose edges cross
  panes        three translucent panes, listed in the wrong order
  images       panels with images of many sizes, each repeated
  bracket      a bracket with ribs, with studio lighting and ambient occlusion
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
  modalcast report render --out report --views
  modalcast report render --out figures --figures
  modalcast report render --out figures --figures --scene path/to/plant --size 1280x960";

/// Error against run time of the renderer: validates every variant against brute-force references, then times it.
///
/// Writes report.json, report.csv, report.md, report.svg, report.png and a folder pictures/ with the references and,
/// for every variant, a strip of rendered, reference and difference image. The files are written after each load: an
/// interrupted run keeps the finished loads and names the missing ones. Exit code 1 when a variant exceeds its error
/// limits.
#[derive(Debug, clap::Args)]
#[command(after_help = WORKLOAD_HELP)]
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
    /// Width and height of still pictures in pixels [default: 640x360]. Moving pictures have a quarter of the width and
    /// of the height. The error limits are for 640x360 and larger pictures. With --figures, the size of each picture
    /// [default: 640x480].
    #[arg(long)]
    size: Option<FrameSize>,
    /// Frames per median, at least 20 [default: 100, 20 with --quick].
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    replays: Option<u32>,
    /// For machines without a GPU: fewer variants (besides those that --variant names in full), references of 16
    /// samples per pixel, and a smaller field.
    #[arg(long)]
    quick: bool,
    /// Draw the figures of the thesis's chapter 4.2 from our own scenes; nothing is measured.
    #[arg(long, conflicts_with_all = ["loads", "variants", "replays", "quick"])]
    figures: bool,
    /// Only compare the CUDA rasterizer with OpenGL, in passes that draw depth or ids, on the loads, a room and two
    /// triangles that fill the frame. Writes raster.json and raster.md. Needs an NVIDIA GPU.
    #[arg(long, conflicts_with_all = ["variants", "figures", "scenes"])]
    raster: bool,
    /// Only measure steps per second with frames in flight by OpenGL's and the CUDA rasterizer, and steps that are not drawn,
    /// on the loads and scenes. Writes pipeline.json. Needs an NVIDIA GPU.
    #[arg(long, conflicts_with_all = ["variants", "figures", "raster"])]
    pipeline: bool,
    /// Only measure batches of small views, and compare their pictures with single frames. Writes views.json and
    /// views.md. Needs an NVIDIA GPU.
    #[arg(long, conflicts_with_all = ["loads", "variants", "figures", "raster", "pipeline", "scenes", "size"])]
    views: bool,
    /// A scene of your own, a path to a model or a scene folder; repeatable. With --figures, also draws a picture of
    /// it. Without --figures and --pipeline, only its frame times are measured: times.json and a picture.
    #[arg(long = "scene", value_name = "PATH", conflicts_with_all = ["variants", "quick"])]
    scenes: Vec<String>,
}

const DEFAULT_REPORT_SIZE: FrameSize = FrameSize { width: 640, height: 360 };
const DEFAULT_FIGURE_SIZE: FrameSize = FrameSize { width: 640, height: 480 };

/// Maximum width and height of a picture in pixels, because the references trace 16 to 64 samples per pixel.
const MAX_SIDE: u32 = 4096;

/// Runs the report, or the measurement or drawing that an option selects instead.
pub(super) fn run(args: &Args) -> Outcome {
    if args.figures {
        return run_figures(args);
    }
    if args.pipeline {
        return run_pipelines(args);
    }
    if args.views {
        return run_views(args);
    }
    if !args.scenes.is_empty() {
        if !args.loads.is_empty() {
            return Err(invalid("scene", "either --load or --scene, unless with --pipeline", "both"));
        }
        return run_frame_times(args);
    }
    let options = report_options(args)?;
    if args.raster {
        return run_raster_comparison(args, &options);
    }
    let on_progress = |progress: RenderProgress<'_>| match progress {
        RenderProgress::Started(what) => {
            tracing::info!(what, "measuring");
            Ok(())
        }
        RenderProgress::Measured(report) => report.write(&args.out),
    };
    let report = with_spinner("measuring", || render::render(&options, on_progress))?;
    report_lines(&report).into_iter().for_each(print_line);
    print_line(format!("written to {}", args.out.display()));
    Ok(Completion::of_check(report.passed()))
}

fn run_raster_comparison(args: &Args, options: &RenderReportOptions) -> Outcome {
    let comparisons =
        with_spinner("measuring", || render::compare_rasterizers(options, |what| tracing::info!(what, "measuring")))?;
    comparisons.write(&args.out)?;
    comparisons.rows.iter().for_each(|row| print_line(row.line()));
    comparisons.frames.iter().for_each(|row| print_line(row.line()));
    print_line(format!("written to {}", args.out.display()));
    Ok(Completion::of_check(comparisons.passed()))
}

fn run_pipelines(args: &Args) -> Outcome {
    let mut options = report_options(args)?;
    if args.loads.is_empty() && !args.scenes.is_empty() {
        options.loads.clear();
    }
    let report = with_spinner("measuring", || {
        render::measure_pipelines(&options, &args.scenes, |what| tracing::info!(what, "measuring"))
    })?;
    report.write(&args.out)?;
    report.rows.iter().for_each(|row| print_line(row.line()));
    report.undrawn_steps.iter().for_each(|step| print_line(step.line()));
    report.readback.iter().for_each(|rates| print_line(rates.line()));
    print_line(format!("written to {}", args.out.display()));
    Ok(Completion::Success)
}

fn run_views(args: &Args) -> Outcome {
    let (world_count, default_replays) = if args.quick { (256, 20) } else { (4096, 100) };
    let replays = args.replays.map_or(default_replays, |replays| replays as usize);
    let report = with_spinner("measuring", || {
        render::measure_views(world_count, replays, |what| tracing::info!(what, "measuring"))
    })?;
    report.write(&args.out)?;
    report.rows.iter().for_each(|row| print_line(row.line()));
    print_line(format!("written to {}", args.out.display()));
    Ok(Completion::Success)
}

fn run_figures(args: &Args) -> Outcome {
    let options =
        render::figures::FigureOptions { size: size(args, DEFAULT_FIGURE_SIZE)?, scenes: args.scenes.clone() };
    let log_progress = |what: &str| tracing::info!(what, "drawing");
    let figures = with_spinner("drawing", || render::figures::draw_figures(&options, log_progress))?;
    figures.write(&args.out)?;
    for figure in &figures.figures {
        print_line(format!("{:<6}{:<36}{}", figure.name, figure.file, figure.captions.join("; ")));
    }
    print_line(format!("written to {}", args.out.display()));
    Ok(Completion::Success)
}

fn run_frame_times(args: &Args) -> Outcome {
    let replays = args.replays.map_or(100, |replays| replays as usize);
    let options = render::frame_times::FrameTimeOptions {
        scenes: args.scenes.clone(),
        size: size(args, DEFAULT_REPORT_SIZE)?,
        replays,
    };
    let log_progress = |what: &str| tracing::info!(what, "timing");
    let frame_times = with_spinner("measuring", || render::frame_times::time_scenes(&options, log_progress))?;
    frame_times.write(&args.out)?;
    for scene in &frame_times.scenes {
        let frame_us = scene.passes.iter().find(|pass| pass.name == "frame").map_or(0.0, |pass| pass.timing.median_us);
        print_line(format!(
            "{:<24}frame {frame_us:>12.1} us, with readback {:>12.1} us",
            scene.name, scene.wall_clock.median_us
        ));
    }
    print_line(format!("written to {}", args.out.display()));
    Ok(Completion::Success)
}

/// The requested or default size.
///
/// # Errors
/// `Invalid` when a side is not in 1 to [`MAX_SIDE`].
fn size(args: &Args, default_size: FrameSize) -> Result<render::Size> {
    let FrameSize { width, height } = args.size.unwrap_or(default_size);
    match [width, height].iter().all(|side| (1..=MAX_SIDE).contains(side)) {
        true => Ok(render::Size { width, height }),
        false => Err(invalid("size", format!("1 to {MAX_SIDE} pixels a side"), FrameSize { width, height })),
    }
}

fn report_options(args: &Args) -> Result<RenderReportOptions> {
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
    let options = RenderReportOptions {
        loads,
        plants,
        variants: args.variants.clone(),
        size: size(args, DEFAULT_REPORT_SIZE)?,
        quick: args.quick,
        replays: args.replays.map_or(if args.quick { 20 } else { 100 }, |replays| replays as usize),
    };
    match options.selected_variants().is_empty() {
        false => Ok(options),
        true => {
            let names: Vec<String> = variants::all(false).into_iter().map(|variant| variant.name).collect();
            Err(invalid("variant", format!("one or more of: {}", names.join("; ")), args.variants.join("; ")))
        }
    }
}

/// Indices from 0 of the plants that a name selects; `None` when the name selects no plant.
fn plants_named(name: &str) -> Option<Vec<usize>> {
    if name == "plants" {
        return Some((0..PLANTS.len()).collect());
    }
    let number: usize = name.strip_prefix("plant-")?.parse().ok()?;
    (1..=PLANTS.len()).contains(&number).then(|| vec![number - 1])
}

/// The report as lines of text: rows, readback, plants, minimal passes, rasterizers and failures.
fn report_lines(report: &RenderReport) -> Vec<String> {
    // "color" compares with hard shadows. "intended" to "bleeding" compare with what the variant should draw, which may
    // be a filtered shadow.
    let headings = ["frame us", "color", "intended", "light", "penumbra", "bleeding", "flicker", "passed"];
    let mut lines =
        vec![format!("{:<18}{:<40}{}", "load", "variant", headings.map(|word| format!("{word:>10}")).concat())];
    for row in &report.rows {
        let format_number =
            |number: Option<f64>, digits: usize| number.map_or("-".into(), |number| format!("{number:.digits$}"));
        let cells = [
            format_number(row.median_us(), 1),
            format_number(Some(row.color_errors.mean), 3),
            format_number(Some(row.intended_color_errors.mean), 3),
            format_number(Some(row.intended_light_errors.all_pixels.mean), 4),
            format_number(Some(row.intended_light_errors.penumbra.mean), 4),
            format_number(row.intended_light_errors.umbra_visibility, 4),
            format_number(row.flicker.map(|flicker| flicker.mean), 3),
            match (row.passed, row.is_expected_to_fail) {
                (true, _) => "yes".into(),
                (false, true) => "as expected".into(),
                (false, false) => "NO".into(),
            },
        ];
        lines.push(format!("{:<18}{:<40}{}", row.load, row.name, cells.map(|cell| format!("{cell:>10}")).concat()));
    }
    lines.extend(report.readback.iter().map(|row| {
        let (load, unread_fps, ring_fps, ring_loss) = (&row.load, row.unread_fps, row.ring_fps, row.ring_loss);
        format!(
            "{load:<18}{unread_fps:.1} frames/s without readback, {ring_fps:.1} with readback: {ring_loss:.1} % fewer"
        )
    }));
    // The thesis calls vertex updating with rendering t_vbr, and its share of the frame time O_vbr.
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
            "{:<18}shadow map {}: minimal depth pass {depth:.1} us, minimal visibility pass {visibility:.1} us",
            minimal.load, minimal.map_size
        ));
        lines.extend([&minimal.without_culling, &minimal.with_scene_culling].map(|frame| {
            let (name, frame_us, excess_us) = (&frame.name, frame.frame_us, frame.excess_us);
            format!("{:<18}{name} takes {frame_us:.1} us, {excess_us:.1} us more than both passes", "")
        }));
    }
    lines.extend(report.raster.iter().map(render::RasterComparison::line));
    lines.push(format!("rasterizer by default: {}", RasterFacts::rule()));
    lines.extend(report.failed.iter().map(|failed| format!("failed: {failed}")));
    lines.extend(report.default_shadow.iter().flat_map(render::DefaultShadow::lines));
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
            pipeline: false,
            raster: false,
            views: false,
            scenes: vec![],
        }
    }

    #[test]
    fn defaults_to_all_loads_and_rejects_bad_names_and_sizes() {
        let default_options = report_options(&args()).expect("valid options");
        assert_eq!(
            (default_options.loads.len(), default_options.plants.len(), default_options.replays),
            (RenderWorkload::all(true).len(), 12, 20)
        );
        let plant_args = Args { loads: ["plant-3", "square", "plants"].map(String::from).to_vec(), ..args() };
        // The twelve plants and once more plant-3, whose index is 2.
        let options = report_options(&plant_args).expect("valid options");
        assert_eq!((options.loads.len(), options.plants.len(), options.plants[0]), (1, 13, 2));
        let named_args = Args { loads: vec!["square".into(), "triangles-10".into()], replays: Some(7), ..args() };
        assert_eq!(
            report_options(&named_args).expect("valid options").loads,
            [RenderWorkload::Square, RenderWorkload::Triangles(10)]
        );
        // A quick run also includes variants that are named in full.
        let variants = ["variance 4096, blur 1.5", "culling*"].map(String::from).to_vec();
        let selected_variants =
            report_options(&Args { variants, ..args() }).expect("valid options").selected_variants();
        let variant_names: Vec<&str> = selected_variants.iter().map(|variant| variant.name.as_str()).collect();
        assert_eq!(variant_names, ["variance 4096, blur 1.5", "culling none", "culling triangles", "culling depth"]);
        assert_eq!(
            report_options(&args()).expect("valid options").selected_variants().len(),
            variants::all(true).len()
        );
        for invalid_args in [
            Args { loads: vec!["cube".into()], ..args() },
            Args { loads: vec!["plant-13".into()], ..args() },
            Args { variants: vec!["varience*".into()], ..args() },
            Args { size: Some(FrameSize { width: 0, height: 5 }), ..args() },
            Args { size: Some(FrameSize { width: 5, height: 5000 }), ..args() },
        ] {
            assert!(report_options(&invalid_args).is_err(), "{invalid_args:?}");
        }
    }
}
