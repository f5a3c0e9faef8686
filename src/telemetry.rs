//! Stage names in one enum, stage times in milliseconds, and the log.

/// A stage of the work; its name is the same in logs, replies and records.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Stage {
    Parse,
    Queue,
    Deform,
    Upload,
    Shadow,
    Draw,
    Read,
    Encode,
    Copy,
}

impl Stage {
    /// The stage's name.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Parse => "parse",
            Self::Queue => "queue",
            Self::Deform => "deform",
            Self::Upload => "upload",
            Self::Shadow => "shadow",
            Self::Draw => "draw",
            Self::Read => "read",
            Self::Encode => "encode",
            Self::Copy => "copy",
        }
    }
}

/// Milliseconds per stage, in the order in which they were run.
pub type StageTimes = Vec<(Stage, f64)>;
