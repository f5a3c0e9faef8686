//! Elements of a PLY file: the properties of a vertex and of a face that are read.

use ply_rs_bw::ply::{Property, PropertyAccess, PropertyAccessResult};

/// A vertex. A property that the file does not have is 0.
#[derive(Debug, Default, Clone, PartialEq)]
pub(super) struct PlyVertex {
    pub(super) position: [f32; 3],
    pub(super) normal: [f32; 3],
    pub(super) uv: [f32; 2],
    /// 0 to 1.
    pub(super) color: [f32; 3],
}

/// A face.
#[derive(Debug, Default, Clone, PartialEq)]
pub(super) struct PlyFace {
    pub(super) vertices: Vec<i64>,
    /// Two texture coordinates per corner; empty if the file has none per face.
    pub(super) uvs: Vec<f32>,
}

/// An element that is not used.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Skipped;

impl PropertyAccess for PlyVertex {
    fn new() -> Self {
        Self::default()
    }

    fn set_property(&mut self, name: &str, property: Property) -> PropertyAccessResult {
        let target = match name {
            "x" => &mut self.position[0],
            "y" => &mut self.position[1],
            "z" => &mut self.position[2],
            "nx" => &mut self.normal[0],
            "ny" => &mut self.normal[1],
            "nz" => &mut self.normal[2],
            "s" | "u" | "texture_u" => &mut self.uv[0],
            "t" | "v" | "texture_v" => &mut self.uv[1],
            "red" => &mut self.color[0],
            "green" => &mut self.color[1],
            "blue" => &mut self.color[2],
            _ => return PropertyAccessResult::Ignored,
        };
        // Colors of whole numbers have the range of their type.
        let is_color = matches!(name, "red" | "green" | "blue");
        let (value, full) = match property {
            Property::Char(value) => (f64::from(value), 127.0),
            Property::UChar(value) => (f64::from(value), 255.0),
            Property::Short(value) => (f64::from(value), 32767.0),
            Property::UShort(value) => (f64::from(value), 65535.0),
            Property::Int(value) => (f64::from(value), 255.0),
            Property::UInt(value) => (f64::from(value), 255.0),
            Property::Float(value) => (f64::from(value), 1.0),
            Property::Double(value) => (value, 1.0),
            _ => return PropertyAccessResult::UnsupportedType,
        };
        *target = if is_color { value / full } else { value } as f32;
        PropertyAccessResult::Set
    }
}

impl PropertyAccess for PlyFace {
    fn new() -> Self {
        Self::default()
    }

    fn set_property(&mut self, name: &str, property: Property) -> PropertyAccessResult {
        match (name, property) {
            ("vertex_indices" | "vertex_index", property) => match to_indices(property) {
                Some(vertices) => self.vertices = vertices,
                None => return PropertyAccessResult::UnsupportedType,
            },
            ("texcoord", Property::ListFloat(uvs)) => self.uvs = uvs,
            ("texcoord", Property::ListDouble(uvs)) => self.uvs = uvs.into_iter().map(|number| number as f32).collect(),
            _ => return PropertyAccessResult::Ignored,
        }
        PropertyAccessResult::Set
    }
}

fn to_indices(property: Property) -> Option<Vec<i64>> {
    fn convert<T: Into<i64>>(list: Vec<T>) -> Option<Vec<i64>> {
        Some(list.into_iter().map(Into::into).collect())
    }
    match property {
        Property::ListChar(list) => convert(list),
        Property::ListUChar(list) => convert(list),
        Property::ListShort(list) => convert(list),
        Property::ListUShort(list) => convert(list),
        Property::ListInt(list) => convert(list),
        Property::ListUInt(list) => convert(list),
        _ => None,
    }
}

impl PropertyAccess for Skipped {
    fn new() -> Self {
        Self
    }
}
