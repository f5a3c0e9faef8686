//! Names of the passes and stages of a frame, and their times.
//!
//! [`Pass`] is the only source of these names: plans, statistics, times and error stages take them from it.

use std::fmt;

use serde::{Serialize, Serializer};

/// A pass of the renderer. The order of the variants is the order of execution. The last three run only on request.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Pass {
    /// Writes the uniforms of the frame and resets its counters.
    UniformUpload,
    /// Draws the shadow depth with the compute rasterizer, and the visibility if the compute rasterizer draws both.
    RasterShadow,
    /// Draws the visibility with the compute rasterizer.
    RasterVisibility,
    /// Lists the triangles that may cast a shadow.
    ShadowCull,
    /// Draws the depth as seen from the sun.
    Shadow,
    /// Converts shadow depth to moments and blurs them.
    Blur,
    /// Draws the depth of the triangles that were visible in the last frame, and builds the Hi-Z pyramid.
    Occluders,
    /// Lists the triangles that the camera may see.
    Cull,
    /// Draws the triangle id and the depth of each sample.
    Visibility,
    /// Records the visible triangles as the occluders of the next frame.
    RecordVisible,
    /// Converts the keys of the compute rasterizer (triangle and depth) to ids.
    Unpack,
    /// Finds the surface of each texel of the ambient occlusion, and how much ambient light reaches it.
    AmbientOcclusion,
    /// Blends translucent triangles in draw order.
    Blended,
    /// Counts the blended fragments of each pixel.
    OitCount,
    /// Allocates the fragment list of each pixel.
    OitAllocate,
    /// Fills the fragment lists.
    OitFill,
    /// Sorts, shades and blends the fragment lists.
    OitResolve,
    /// Shades tiles that see no opaque triangle, and lists the other tiles.
    Background,
    /// Shades the listed tiles.
    Shade,
    /// Adds blurred bright light to the shaded image.
    Bloom,
    /// Encodes linear light to sRGB bytes.
    Encode,
    /// Copies the sRGB bytes and the statistics to the staging buffer, or the statistics alone to a shared picture.
    Read,
    /// Reads back the id of the first sample of each pixel.
    VisibilityReadback,
    /// Draws and reads back the triangles of a few pixels.
    Pick,
    /// Draws and reads back an AOV field instead of colors.
    Aov,
}

/// A part of a frame whose time is reported as the sum over its passes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum RenderStage {
    /// Upload of deformed vertices from host memory; measured by the caller.
    Upload,
    /// Time before the device begins the frame, counted from the begin of its recording or from the end of the frame
    /// that was read last, whichever is later. Includes the change from CUDA to OpenGL, and other work of the device.
    /// If a compute rasterizer draws into shared memory, the wait of the host for it is added, without its device time:
    /// for frames of OpenGL in flight, and for the change from OpenGL to CUDA. Not measured with software rasterizers.
    Switch,
    Shadow,
    Draw,
    Read,
}

impl Pass {
    /// All passes, in execution order.
    pub const ALL: [Self; 25] = [
        Self::UniformUpload,
        Self::RasterShadow,
        Self::RasterVisibility,
        Self::ShadowCull,
        Self::Shadow,
        Self::Blur,
        Self::Occluders,
        Self::Cull,
        Self::Visibility,
        Self::RecordVisible,
        Self::Unpack,
        Self::AmbientOcclusion,
        Self::Blended,
        Self::OitCount,
        Self::OitAllocate,
        Self::OitFill,
        Self::OitResolve,
        Self::Background,
        Self::Shade,
        Self::Bloom,
        Self::Encode,
        Self::Read,
        Self::VisibilityReadback,
        Self::Pick,
        Self::Aov,
    ];

    /// Name in plans, statistics, times and errors.
    pub const fn name(self) -> &'static str {
        match self {
            Self::UniformUpload => "uniform upload",
            Self::RasterShadow => "raster shadow",
            Self::RasterVisibility => "raster visibility",
            Self::ShadowCull => "shadow cull",
            Self::Shadow => "shadow",
            Self::Blur => "blur",
            Self::Occluders => "occluders",
            Self::Cull => "cull",
            Self::Visibility => "visibility",
            Self::RecordVisible => "record visible",
            Self::Unpack => "unpack",
            Self::AmbientOcclusion => "ambient occlusion",
            Self::Blended => "blended",
            Self::OitCount => "oit count",
            Self::OitAllocate => "oit allocate",
            Self::OitFill => "oit fill",
            Self::OitResolve => "oit resolve",
            Self::Background => "background",
            Self::Shade => "shade",
            Self::Bloom => "bloom",
            Self::Encode => "encode",
            Self::Read => "read",
            Self::VisibilityReadback => "visibility readback",
            Self::Pick => "pick",
            Self::Aov => "aov",
        }
    }

    /// The stage that includes the time of the pass.
    pub const fn stage(self) -> RenderStage {
        match self {
            Self::RasterShadow | Self::ShadowCull | Self::Shadow | Self::Blur => RenderStage::Shadow,
            Self::Read => RenderStage::Read,
            _ => RenderStage::Draw,
        }
    }
}

impl fmt::Display for Pass {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(self.name())
    }
}

impl Serialize for Pass {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

impl RenderStage {
    /// Name in times.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Upload => "upload",
            Self::Switch => "switch",
            Self::Shadow => "shadow",
            Self::Draw => "draw",
            Self::Read => "read",
        }
    }
}

/// The stage or pass of a measured time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TimeKey {
    Stage(RenderStage),
    /// Passes that are timed together have the name of one of them. "visibility" includes the conversion of keys,
    /// "cull" the occluders, "blended" the fragment lists, "shade" the background, and "raster shadow" the visibility
    /// if the compute rasterizer draws both.
    Pass(Pass),
}

impl TimeKey {
    /// Name of the stage or pass.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Stage(stage) => stage.name(),
            Self::Pass(pass) => pass.name(),
        }
    }
}

/// Milliseconds of the stages of a frame and of their passes. A stage precedes its passes.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct FrameTimes(Vec<(TimeKey, f64)>);

impl FrameTimes {
    /// Sums the times of a frame's passes to stages. The shadow pass has no entry of its own, because its stage has the
    /// same name.
    pub(crate) fn of_passes(passes: &[(Pass, f64)]) -> Self {
        let passes_of = |stage: RenderStage| passes.iter().filter(move |(pass, _)| pass.stage() == stage);
        let stage_ms = |stage: RenderStage| passes_of(stage).map(|(_, ms)| ms).fold(0.0, |sum, ms| sum + ms);
        let timed_pass = |(pass, ms): &(Pass, f64)| (TimeKey::Pass(*pass), *ms);
        let mut times = vec![(TimeKey::Stage(RenderStage::Shadow), stage_ms(RenderStage::Shadow))];
        times.extend(passes_of(RenderStage::Shadow).filter(|(pass, _)| *pass != Pass::Shadow).map(timed_pass));
        times.push((TimeKey::Stage(RenderStage::Draw), stage_ms(RenderStage::Draw)));
        times.extend(passes_of(RenderStage::Draw).map(timed_pass));
        times.extend(passes_of(RenderStage::Read).map(|(_, ms)| (TimeKey::Stage(RenderStage::Read), *ms)));
        Self(times)
    }

    /// Times of stages without passes.
    pub(crate) fn of_stages(stages: &[(RenderStage, f64)]) -> Self {
        Self(stages.iter().map(|(stage, ms)| (TimeKey::Stage(*stage), *ms)).collect())
    }

    /// Inserts the time of a stage before all others.
    pub(crate) fn insert_first(&mut self, stage: RenderStage, ms: f64) {
        self.0.insert(0, (TimeKey::Stage(stage), ms));
    }

    /// Adds `ms` to the time of a stage; does nothing if the frame has no such stage.
    pub(crate) fn add(&mut self, stage: RenderStage, ms: f64) {
        if let Some((_, sum)) = self.0.iter_mut().find(|(key, _)| *key == TimeKey::Stage(stage)) {
            *sum += ms;
        }
    }

    /// Milliseconds of a stage; none if the frame has no such stage.
    pub fn stage(&self, stage: RenderStage) -> Option<f64> {
        self.0.iter().find(|(key, _)| *key == TimeKey::Stage(stage)).map(|(_, ms)| *ms)
    }

    /// Milliseconds of the shadow and draw stages: the device time of a frame without its readback.
    pub fn drawing_ms(&self) -> f64 {
        [RenderStage::Shadow, RenderStage::Draw].into_iter().filter_map(|stage| self.stage(stage)).sum()
    }

    /// Milliseconds of a timed pass; none if the frame did not time it.
    pub fn pass(&self, pass: Pass) -> Option<f64> {
        self.0.iter().find(|(key, _)| *key == TimeKey::Pass(pass)).map(|(_, ms)| *ms)
    }

    /// All times, in order.
    pub fn iter(&self) -> impl Iterator<Item = (TimeKey, f64)> {
        self.0.iter().copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_contains_each_pass_with_a_unique_name() {
        assert!(Pass::ALL.is_sorted_by(|pass, next_pass| pass < next_pass));
        assert_eq!(Pass::ALL.len(), Pass::Aov as usize + 1);
        let mut names = Pass::ALL.map(Pass::name);
        names.sort_unstable();
        assert!(names.windows(2).all(|pair| pair[0] != pair[1]), "{names:?}");
    }

    #[test]
    fn stages_are_the_sums_of_their_passes() {
        // Powers of two, so that each sum shows its terms.
        let passes = [
            (Pass::RasterShadow, 1.0),
            (Pass::Shadow, 2.0),
            (Pass::Blur, 4.0),
            (Pass::Visibility, 8.0),
            (Pass::Encode, 16.0),
            (Pass::Read, 32.0),
        ];
        let mut times = FrameTimes::of_passes(&passes);
        times.add(RenderStage::Read, 64.0);
        let named_times: Vec<(&str, f64)> = times.iter().map(|(key, ms)| (key.name(), ms)).collect();
        let expected = [
            ("shadow", 7.0),
            ("raster shadow", 1.0),
            ("blur", 4.0),
            ("draw", 24.0),
            ("visibility", 8.0),
            ("encode", 16.0),
            ("read", 96.0),
        ];
        assert_eq!(named_times, expected);
        assert_eq!((times.pass(Pass::Blur), times.pass(Pass::Shadow)), (Some(4.0), None));
        assert_eq!((times.stage(RenderStage::Shadow), times.drawing_ms()), (Some(7.0), 31.0));
    }
}
