//! Options of pictures that several programs share.

use std::path::Path;

use clap::{Args, ValueEnum};

use crate::frames::{Camera, FrameFormat, Lens, Output, Picture, View};

/// Options of the picture.
#[derive(Debug, Clone, Args)]
pub struct PictureOptions {
    /// Image size in pixels.
    #[arg(long, default_value = "1280x720", value_name = "WxH", value_parser = parse_size)]
    size: (u32, u32),
    /// Content of the picture: color, depth (f32 meters), domains (u32), normals (3 f32), or a color map of
    /// `displacement` or `mode-shape` with a legend. Several, separated by commas, are saved as one file each, whose
    /// name ends with the name of the output. All files show the same step.
    #[arg(long = "output", value_enum, default_value = "color", value_delimiter = ',')]
    outputs: Vec<OutputOption>,
    /// Index of the column of U for `--output mode-shape`, from 0.
    #[arg(long, requires = "outputs", default_value_t = 0)]
    mode: u32,
    /// Value at the bright end of the color map, in meters (`displacement`) or meters per unit of q (`mode-shape`); 0
    /// fits the color map to each frame.
    #[arg(long = "largest", value_name = "VALUE", requires = "outputs", default_value_t = 0.0)]
    scale_max: f64,
    /// Encoding of color pictures and color maps: PNG, JPEG, or raw RGBA8 (top row first, sRGB). Default: that of the
    /// extension of a single file (.jpg, .jpeg or .rgba), else PNG.
    #[arg(long, value_enum)]
    format: Option<FormatOption>,
    /// Quality of JPEG, 1 (smallest file) to 100 (smallest error). Default: 90. Ignored by other formats.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=100))]
    quality: Option<u32>,
    /// Samples per pixel of color pictures: 1 or 4. Default: as the scene sets them, else 4 for a single frame, and the
    /// choice of the server for a stream.
    #[arg(long, value_parser = parse_samples)]
    samples: Option<u32>,
    /// Position of the camera in scene units. Default: a camera that shows the whole scene.
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_vector, requires = "target", allow_hyphen_values = true)]
    eye: Option<[f64; 3]>,
    /// Point that the camera looks at, in scene units.
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_vector, requires = "eye", allow_hyphen_values = true)]
    target: Option<[f64; 3]>,
    /// Up direction of the camera. Default: the up axis of the scene.
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_vector, requires = "eye", allow_hyphen_values = true)]
    up: Option<[f64; 3]>,
    /// Vertical field of view in degrees. Default: 35.
    #[arg(long, requires = "eye", value_name = "DEGREES")]
    field_of_view: Option<f64>,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum FormatOption {
    Png,
    Jpeg,
    Raw,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum OutputOption {
    Color,
    Depth,
    DepthWithGround,
    Domains,
    Normals,
    Displacement,
    ModeShape,
}

impl PictureOptions {
    /// One picture per output.
    pub fn pictures(&self) -> Vec<Picture> {
        self.pictures_in(self.format.unwrap_or(FormatOption::Png))
    }

    /// One picture per output, for a single file. Its extension selects the encoding unless `--format` does.
    pub fn pictures_for_file(&self, path: &Path) -> Vec<Picture> {
        let extension = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
        self.pictures_in(self.format.unwrap_or(match extension.as_str() {
            "jpg" | "jpeg" => FormatOption::Jpeg,
            "rgba" => FormatOption::Raw,
            _ => FormatOption::Png,
        }))
    }

    fn pictures_in(&self, format: FormatOption) -> Vec<Picture> {
        self.outputs.iter().map(|output| self.picture(*output, format)).collect()
    }

    /// The end of the file name of each picture: empty for a single picture, else `_` and the name of its output.
    pub fn file_suffixes(&self) -> Vec<String> {
        let suffix = |output: &OutputOption| match (self.outputs.len(), output.to_possible_value()) {
            (2.., Some(value)) => format!("_{}", value.get_name()),
            _ => String::new(),
        };
        self.outputs.iter().map(suffix).collect()
    }

    fn picture(&self, output: OutputOption, format: FormatOption) -> Picture {
        let view = self.eye.zip(self.target).map(|(eye, target)| View::LookAt { eye, target, up: self.up });
        let camera =
            view.map(|view| Camera { view, lens: Lens::FieldOfView(self.field_of_view.unwrap_or(35.0)), clip: None });
        let format = match format {
            FormatOption::Png => FrameFormat::Png,
            FormatOption::Jpeg => FrameFormat::Jpeg,
            FormatOption::Raw => FrameFormat::Rgba,
        };
        let (mode, scale_max) = (self.mode, self.scale_max);
        let output = match output {
            OutputOption::Color => Output::Color,
            OutputOption::Depth => Output::Depth,
            OutputOption::DepthWithGround => Output::DepthWithGround,
            OutputOption::Domains => Output::Domains,
            OutputOption::Normals => Output::Normals,
            OutputOption::Displacement => Output::Displacement { scale_max },
            OutputOption::ModeShape => Output::ModeShape { mode, scale_max },
        };
        let jpeg_quality = self.quality.unwrap_or(0);
        let samples = if output == Output::Color { self.samples.unwrap_or(0) } else { 0 };
        let (width, height) = self.size;
        Picture { width, height, format, camera, output, jpeg_quality, edge_width: None, samples }
    }
}

fn parse_size(text: &str) -> Result<(u32, u32), String> {
    let size = text.split_once('x').and_then(|(width, height)| Some((width.parse().ok()?, height.parse().ok()?)));
    size.filter(|(width, height)| *width > 0 && *height > 0)
        .ok_or_else(|| "expected WIDTHxHEIGHT with positive integers, such as 1280x720".into())
}

fn parse_samples(text: &str) -> Result<u32, String> {
    match text {
        "1" => Ok(1),
        "4" => Ok(4),
        _ => Err("expected 1 or 4".into()),
    }
}

fn parse_vector(text: &str) -> Result<[f64; 3], String> {
    let numbers: Option<Vec<f64>> = text.split(',').map(|number| number.trim().parse().ok()).collect();
    let vector = numbers.and_then(|numbers| <[f64; 3]>::try_from(numbers).ok());
    vector
        .filter(|vector| vector.iter().all(|component| component.is_finite()))
        .ok_or_else(|| "expected three finite numbers X,Y,Z".into())
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Program {
        #[command(flatten)]
        picture: PictureOptions,
    }

    fn picture_options(arguments: &[&str]) -> PictureOptions {
        let command = [&["program"], arguments].concat();
        Program::try_parse_from(command).expect("expected valid arguments").picture
    }

    #[test]
    fn outputs_are_pictures_with_their_own_files() {
        let single = picture_options(&["--output", "depth"]);
        assert_eq!((single.pictures()[0].output, single.file_suffixes()), (Output::Depth, vec![String::new()]));
        let several = picture_options(&["--output", "color,mode-shape", "--mode", "2", "--format", "jpeg"]);
        assert_eq!(several.file_suffixes(), ["_color", "_mode-shape"]);
        let outputs = several.pictures().into_iter().map(|picture| (picture.format, picture.output));
        let expected = [Output::Color, Output::ModeShape { mode: 2, scale_max: 0.0 }];
        assert!(outputs.eq(expected.map(|output| (FrameFormat::Jpeg, output))));
        assert_eq!(picture_options(&["--format", "jpeg", "--quality", "35"]).pictures()[0].jpeg_quality, 35);
        let pictures = picture_options(&["--output", "color,depth", "--samples", "4"]).pictures();
        assert_eq!([pictures[0].samples, pictures[1].samples], [4, 0]);
        assert!(Program::try_parse_from(["program", "--samples", "2"]).is_err());
        for (arguments, file, format) in [
            (&[][..], "x.jpg", FrameFormat::Jpeg),
            (&[], "x.y.JPEG", FrameFormat::Jpeg),
            (&[], "x.rgba", FrameFormat::Rgba),
            (&[], "x", FrameFormat::Png),
            (&["--format", "png"], "x.jpg", FrameFormat::Png),
        ] {
            assert_eq!(picture_options(arguments).pictures_for_file(Path::new(file))[0].format, format, "{file}");
        }
    }

    #[test]
    fn valid_sizes_and_vectors_are_parsed() {
        assert_eq!(parse_size("1280x720"), Ok((1280, 720)));
        assert_eq!(parse_vector("1, -2,.5"), Ok([1.0, -2.0, 0.5]));
    }

    #[test]
    fn invalid_sizes_and_vectors_are_rejected() {
        for text in ["", "1280", "0x5", "-1x5", "axb", "5x5x5"] {
            assert!(parse_size(text).is_err(), "{text}");
        }
        for text in ["", "1,2", "1,2,3,4", "1,2,nan", "inf,0,0"] {
            assert!(parse_vector(text).is_err(), "{text}");
        }
    }
}
