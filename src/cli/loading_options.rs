//! Options on how the files of a scene are read. The commands that open a scene and the program `modalcast-modes` share
//! them, so that an option means the same everywhere.

use modalcast_model::load::LoadOptions;
use modalcast_model::scene::{LengthUnit, Lighting, UpAxis};

/// Unit, up axis, lighting and strictness.
#[derive(Debug, Clone, Copy, Default, PartialEq, clap::Args)]
pub(crate) struct LoadingOptions {
    /// Unit of the lengths in the file: m, mm, cm, um, in, ft, or a number of meters. Replaces the key `unit` of
    /// scene.toml [default: m].
    #[arg(long, value_name = "UNIT")]
    pub(crate) unit: Option<LengthUnit>,
    /// Axis of the file that points up: x, y or z. Replaces the key `up` of scene.toml [default: that of the file's
    /// format].
    #[arg(long, value_name = "AXIS")]
    pub(crate) up: Option<UpAxis>,
    /// Lights and background: outdoor (sun, sky and ground) or studio. Replaces the key `look.lighting` of scene.toml
    /// [default: studio for models without materials of their own, else outdoor].
    #[arg(long, value_name = "NAME")]
    pub(crate) lighting: Option<Lighting>,
    /// Treat missing material libraries, materials and images, images of unsupported formats, and values out of range,
    /// not finite or not understood, as errors instead of remarks.
    #[arg(long)]
    pub(crate) strict: bool,
}

impl LoadingOptions {
    /// The options of the loaders.
    pub(crate) fn load_options(&self) -> LoadOptions {
        LoadOptions { is_strict: self.strict, unit: self.unit, up: self.up, lighting: self.lighting }
    }

    /// The flags of the options that are given and that the modes depend on.
    #[allow(dead_code, reason = "modalcast-modes starts no program")]
    pub(crate) fn arguments(&self) -> Vec<String> {
        let unit = self.unit.map(|unit| format!("--unit={unit}"));
        let up = self.up.map(|up| format!("--up={}", up.name()));
        let strict = self.strict.then(|| "--strict".to_owned());
        unit.into_iter().chain(up).chain(strict).collect()
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Cli {
        #[command(flatten)]
        options: LoadingOptions,
    }

    fn parse(arguments: &[&str]) -> Result<LoadingOptions, clap::Error> {
        Cli::try_parse_from([&["program"][..], arguments].concat()).map(|cli| cli.options)
    }

    #[test]
    fn arguments_give_the_same_options() {
        for (words, flags) in [
            (&[][..], &[][..]),
            (&["--unit", "mm"][..], &["--unit=mm"][..]),
            (&["--unit", "0.5", "--up", "Z", "--strict"][..], &["--unit=0.5", "--up=z", "--strict"][..]),
        ] {
            let options = parse(words).expect("valid options");
            assert_eq!(options.arguments(), flags);
            assert_eq!(parse(flags).expect("valid options"), options);
        }
        assert!(parse(&["--lighting", "outdoor"]).expect("valid options").arguments().is_empty());
        let options = parse(&["--unit", "in", "--up", "x"]).expect("valid options").load_options();
        let unit = options.unit.expect("a unit").meters();
        assert_eq!((unit, options.up, options.is_strict), (0.0254, Some(UpAxis::X), false));
    }

    #[test]
    fn unknown_units_and_axes_are_rejected_with_the_known_ones() {
        for (words, expected) in [
            (["--unit", "yard"], "expected m, mm, cm"),
            (["--unit", "0"], "1e-12 to 1e12"),
            (["--up", "w"], "x, y or z"),
            (["--lighting", "garage"], "outdoor or studio"),
        ] {
            let message = parse(&words).expect_err("an error").to_string();
            assert!(message.contains(expected), "{message}");
        }
    }
}
