//! Progress on stderr.

use std::io::{IsTerminal as _, Write as _};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle as BarStyle};

/// How progress is printed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum ProgressStyle {
    /// A bar if stderr is a terminal, else nothing.
    #[default]
    Auto,
    Bar,
    /// Lines such as `progress 0.350 factorization`, for other programs.
    Lines,
    None,
}

/// Prints progress in the chosen style.
pub(crate) struct Reporter {
    bar: Option<ProgressBar>,
    prints_lines: bool,
}

/// Steps of the bar.
const STEPS: u64 = 1000;

impl Reporter {
    pub(crate) fn new(style: ProgressStyle) -> Self {
        let has_bar = style == ProgressStyle::Bar || style == ProgressStyle::Auto && std::io::stderr().is_terminal();
        let bar = has_bar.then(|| {
            let bar = ProgressBar::with_draw_target(Some(STEPS), ProgressDrawTarget::stderr());
            if let Ok(style) = BarStyle::with_template("{bar:32} {percent:>3} % {msg}") {
                bar.set_style(style);
            }
            bar
        });
        Self { bar, prints_lines: style == ProgressStyle::Lines }
    }

    pub(crate) fn report(&self, share: f64, stage: &str) {
        if let Some(bar) = &self.bar {
            bar.set_message(stage.to_owned());
            bar.set_position((share * STEPS as f64) as u64);
        }
        if self.prints_lines {
            // Without a reader, the computation goes on.
            writeln!(std::io::stderr(), "progress {share:.3} {stage}").ok();
        }
    }

    /// Removes the bar.
    pub(crate) fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
