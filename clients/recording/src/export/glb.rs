//! Assembles binary glTF files.

use std::fs::File;
use std::io::{BufWriter, Seek as _, SeekFrom, Write as _};
use std::path::Path;

use serde_json::{Map, Value, json};

use crate::error::{Error, Result};

/// Values of `componentType` of an accessor.
const FLOAT: u32 = 5126;
const UNSIGNED_INT: u32 = 5125;

/// The JSON and the binary data of a file. The data are written to a temporary file.
pub(super) struct GlbBuilder<'a> {
    out: &'a Path,
    data: BufWriter<File>,
    data_bytes: u64,
    buffer_views: Vec<Value>,
    accessors: Vec<Value>,
}

/// The type of the elements of an accessor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Element {
    Scalar,
    Vec2,
    Vec3,
    Vec4,
}

impl Element {
    const fn name(self) -> &'static str {
        match self {
            Self::Scalar => "SCALAR",
            Self::Vec2 => "VEC2",
            Self::Vec3 => "VEC3",
            Self::Vec4 => "VEC4",
        }
    }

    const fn components(self) -> usize {
        match self {
            Self::Scalar => 1,
            Self::Vec2 => 2,
            Self::Vec3 => 3,
            Self::Vec4 => 4,
        }
    }
}

impl<'a> GlbBuilder<'a> {
    pub(super) fn new(out: &'a Path) -> Result<Self> {
        let folder = out.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let data = tempfile::tempfile_in(folder).map_err(|error| Error::open(folder, &error))?;
        Ok(Self { out, data: BufWriter::new(data), data_bytes: 0, buffer_views: Vec::new(), accessors: Vec::new() })
    }

    /// Adds bytes at an offset that is a multiple of four. Returns the index of their buffer view.
    pub(super) fn add_view(&mut self, bytes: &[u8]) -> Result<usize> {
        let padding = bytes.len().next_multiple_of(4) - bytes.len();
        let written = self.data.write_all(bytes).and_then(|()| self.data.write_all(&[0; 3][..padding]));
        written.map_err(|error| Error::file(self.out, error))?;
        self.buffer_views.push(json!({ "buffer": 0, "byteOffset": self.data_bytes, "byteLength": bytes.len() }));
        self.data_bytes += (bytes.len() + padding) as u64;
        Ok(self.buffer_views.len() - 1)
    }

    /// Adds an accessor of f32 numbers with their bounds.
    pub(super) fn add_floats(&mut self, element: Element, numbers: &[f32]) -> Result<usize> {
        let view = self.add_view(bytemuck::cast_slice(numbers))?;
        let components = element.components();
        let bound = |start: f32, choose: fn(f32, f32) -> f32| -> Vec<f32> {
            (0..components)
                .map(|component| numbers.iter().skip(component).step_by(components).copied().fold(start, choose))
                .collect()
        };
        self.accessors.push(json!({
            "bufferView": view, "componentType": FLOAT, "type": element.name(), "count": numbers.len() / components,
            "min": bound(f32::MAX, f32::min), "max": bound(f32::MIN, f32::max),
        }));
        Ok(self.accessors.len() - 1)
    }

    /// Adds an accessor of `count` indices in a view, from index `first` on.
    pub(super) fn add_indices(&mut self, view: usize, first: usize, count: usize) -> usize {
        self.accessors.push(json!({
            "bufferView": view, "componentType": UNSIGNED_INT, "type": "SCALAR", "byteOffset": 4 * first, "count": count,
        }));
        self.accessors.len() - 1
    }

    /// Writes the file. `document` has all parts of the JSON but the buffers, buffer views and accessors.
    pub(super) fn finish(self, mut document: Map<String, Value>) -> Result<()> {
        let Self { out, data, data_bytes, buffer_views, accessors } = self;
        document.insert("buffers".into(), json!([{ "byteLength": data_bytes }]));
        document.insert("bufferViews".into(), buffer_views.into());
        document.insert("accessors".into(), accessors.into());
        let mut text = serde_json::to_vec(&document).map_err(|error| Error::file(out, error))?;
        text.resize(text.len().next_multiple_of(4), b' ');
        // The file has a header of 12 bytes, and each of its two chunks one of 8 bytes.
        let total = 12 + 8 + text.len() as u64 + 8 + data_bytes;
        if total > u64::from(u32::MAX) {
            return Err(Error::invalid(
                "--to gltf",
                "at most 4 GiB, the limit of the format",
                format!("{total} bytes"),
            ));
        }
        let write = || -> std::io::Result<()> {
            let mut data = data.into_inner().map_err(std::io::IntoInnerError::into_error)?;
            data.seek(SeekFrom::Start(0))?;
            let mut file = BufWriter::new(File::create(out)?);
            file.write_all(b"glTF")?;
            // The version of glTF, the size of the file, and the size of the JSON chunk.
            [2, total as u32, text.len() as u32].iter().try_for_each(|number| file.write_all(&number.to_le_bytes()))?;
            file.write_all(b"JSON")?;
            file.write_all(&text)?;
            file.write_all(&(data_bytes as u32).to_le_bytes())?;
            file.write_all(b"BIN\0")?;
            std::io::copy(&mut data, &mut file)?;
            file.flush()
        };
        write().map_err(|error| Error::open(out, &error))
    }
}
