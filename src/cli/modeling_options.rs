//! Options of the computation of modes from a surface or a volume mesh. `modalcast view` and the program `modalcast-modes` share them, so
//! that both have the same flags. The program parses the strings.

/// How modes are computed from a surface or a volume mesh. An option that is not given has the default of the program.
#[derive(Debug, Clone, Default, PartialEq, clap::Args)]
#[command(next_help_heading = "Computation of modes")]
pub(crate) struct ModelingOptions {
    /// Number of elastic modes. The rigid modes of a free part are not counted [default: 20; 5 with --large].
    #[arg(long, value_name = "N")]
    pub(crate) modes: Option<usize>,
    /// Large motion of a volume mesh: adds the N (N + 1) / 2 derivatives of the N modes to U, and writes the cubic forces of
    /// a Saint Venant-Kirchhoff material beside the model, as NAME.cub. At most 9 modes.
    #[arg(long)]
    pub(crate) large: bool,
    /// Only modes up to this frequency, in Hz. At most --modes, if both are given.
    #[arg(long, value_name = "HZ", allow_hyphen_values = true)]
    pub(crate) max_frequency: Option<f64>,
    /// Limit on the unknowns of the computation (three per node). For a surface, more are finer and slower. A volume mesh
    /// has as many as it has [default: 25000].
    #[arg(long, value_name = "N")]
    pub(crate) freedoms: Option<usize>,
    /// Material: a name such as steel, or E=Pa,nu=RATIO,rho=KG_PER_M3. GROUP:MATERIAL is for one group or shell of the
    /// surface, or one group of elements, only; can be repeated [default: that of the file (.veg), else steel].
    #[arg(long, value_name = "MATERIAL", allow_hyphen_values = true)]
    pub(crate) material: Vec<String>,
    /// Damping of all modes as a fraction of critical damping, such as 0.01 [default: that of the material].
    #[arg(long, value_name = "RATIO", allow_hyphen_values = true)]
    pub(crate) damping: Option<f64>,
    /// Region that does not move, such as 'z < 0.01', 'x < 0 && y > 1', 'group NAME' or 'near X Y Z RADIUS'. Lengths and
    /// axes are those of the file; can be repeated [default: the part is free].
    #[arg(long, value_name = "REGION", allow_hyphen_values = true)]
    pub(crate) clamp: Vec<String>,
    /// A mass at a point of the surface: 'X Y Z KG'. Lengths and axes are those of the file; can be repeated.
    #[arg(long, value_name = "X Y Z KG", allow_hyphen_values = true)]
    pub(crate) point_mass: Vec<String>,
    /// Thickness of a sheet, for a surface without volume. In the file's unit.
    #[arg(long, value_name = "LENGTH", allow_hyphen_values = true)]
    pub(crate) thickness: Option<f64>,
    /// Number of threads. The result does not depend on it [default: all cores].
    #[arg(long, value_name = "N")]
    pub(crate) threads: Option<usize>,
}

#[allow(dead_code, reason = "modalcast-modes only parses the options")]
impl ModelingOptions {
    /// Whether any option is given.
    pub(crate) fn is_requested(&self) -> bool {
        *self != Self::default()
    }

    /// The flags of the options that are given.
    pub(crate) fn arguments(&self) -> Vec<String> {
        let mut arguments = self.result_arguments();
        arguments.extend(self.threads.map(|threads| format!("--threads={threads}")));
        arguments
    }

    /// The flags that determine the result: all except the number of threads.
    pub(crate) fn result_arguments(&self) -> Vec<String> {
        // Values can start with '-', so a flag and its value are one argument.
        let number = |flag: &str, value: Option<f64>| value.map(|value| format!("--{flag}={value:?}"));
        let count = |flag: &str, value: Option<usize>| value.map(|value| format!("--{flag}={value}"));
        let single = [
            count("modes", self.modes),
            number("max-frequency", self.max_frequency),
            count("freedoms", self.freedoms),
            number("damping", self.damping),
            number("thickness", self.thickness),
        ];
        let repeated = [("material", &self.material), ("clamp", &self.clamp), ("point-mass", &self.point_mass)];
        let repeated =
            repeated.iter().flat_map(|(flag, values)| values.iter().map(move |value| format!("--{flag}={value}")));
        let large = self.large.then(|| "--large".to_owned());
        large.into_iter().chain(single.into_iter().flatten()).chain(repeated).collect()
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Cli {
        #[command(flatten)]
        options: ModelingOptions,
    }

    fn parse(arguments: &[String]) -> ModelingOptions {
        Cli::parse_from(std::iter::once("program").chain(arguments.iter().map(String::as_str))).options
    }

    #[test]
    fn arguments_give_the_same_options() {
        let words = "--large --modes 30 --max-frequency 1e4 --freedoms 9000 --material steel --material a:E=1e9,nu=0.3,rho=1 \
                     --damping 0.02 --clamp -z<0.1 --clamp=x>1 --thickness 0.1 --threads 2";
        let mut words: Vec<String> = words.split_whitespace().map(str::to_owned).collect();
        words.extend(["--point-mass".to_owned(), "-1 0 0 2.5".to_owned()]);
        let options = parse(&words);
        assert_eq!((options.modes, options.max_frequency, options.threads), (Some(30), Some(1e4), Some(2)));
        assert_eq!((options.clamp.join(";"), options.point_mass.join(";")), ("-z<0.1;x>1".into(), "-1 0 0 2.5".into()));
        assert!(options.large);
        assert_eq!(options.arguments().len(), 12);
        assert_eq!(parse(&options.arguments()), options);
        assert!(options.is_requested());
        let one_thread = ModelingOptions { threads: Some(1), ..options.clone() };
        assert_eq!(one_thread.result_arguments(), options.result_arguments());
        assert_ne!(one_thread.arguments(), options.arguments());
    }

    #[test]
    fn no_option_is_no_request() {
        let options = parse(&[]);
        assert!(!options.is_requested() && options.arguments().is_empty());
        assert!(parse(&["--clamp=z<0".to_owned()]).is_requested());
    }
}
