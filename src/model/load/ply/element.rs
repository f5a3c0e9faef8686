//! Elements of a PLY file: the properties of a vertex and of a face that are read.

use ply_rs_bw::ply::{Property, PropertyAccess, PropertyAccessResult, ScalarType};

use crate::load::polygons::within_f32;

/// The properties of one element. Numbers of all types are converted to f64, which is exact for those of PLY.
pub(super) trait PlyElement: PropertyAccess {
    /// Sets a property with one number. `full` is the value of a full channel, if the property is a color.
    fn set_scalar(&mut self, name: &str, value: f64, full: f64);

    /// Sets a property with a list of numbers.
    fn set_list(&mut self, name: &str, values: Vec<f64>);
}

/// A vertex. A property that the file does not have is 0.
#[derive(Debug, Default, Clone, PartialEq)]
pub(super) struct PlyVertex {
    pub(super) position: [f64; 3],
    pub(super) normal: [f32; 3],
    pub(super) uv: [f32; 2],
    /// 0 to 1, or any number in a file whose colors are floating-point numbers.
    pub(super) color: [f32; 3],
}

/// A face.
#[derive(Debug, Default, Clone, PartialEq)]
pub(super) struct PlyFace {
    pub(super) vertices: Vec<f64>,
    /// Two texture coordinates per corner; empty if the file has none per face.
    pub(super) uvs: Vec<f32>,
    /// Index of the image of the face.
    pub(super) texture: Option<f64>,
    /// As [`PlyVertex::color`].
    pub(super) color: [f32; 3],
}

/// An element that is not used.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Skipped;

impl PlyElement for PlyVertex {
    fn set_scalar(&mut self, name: &str, value: f64, full: f64) {
        if let Some(axis) = ["x", "y", "z"].iter().position(|axis| *axis == name) {
            self.position[axis] = within_f32(value);
            return;
        }
        let target = match name {
            "nx" => &mut self.normal[0],
            "ny" => &mut self.normal[1],
            "nz" => &mut self.normal[2],
            "s" | "u" | "texture_u" => &mut self.uv[0],
            "t" | "v" | "texture_v" => &mut self.uv[1],
            "red" => &mut self.color[0],
            "green" => &mut self.color[1],
            "blue" => &mut self.color[2],
            _ => return,
        };
        let is_color = matches!(name, "red" | "green" | "blue");
        *target = if is_color { value / full } else { value } as f32;
    }

    fn set_list(&mut self, _: &str, _: Vec<f64>) {}
}

impl PlyElement for PlyFace {
    fn set_scalar(&mut self, name: &str, value: f64, full: f64) {
        if name == "texnumber" {
            self.texture = Some(value);
        } else if let Some(channel) = ["red", "green", "blue"].iter().position(|channel| *channel == name) {
            self.color[channel] = (value / full) as f32;
        }
    }

    fn set_list(&mut self, name: &str, values: Vec<f64>) {
        match name {
            "vertex_indices" | "vertex_index" => self.vertices = values,
            "texcoord" => self.uvs = values.into_iter().map(|number| number as f32).collect(),
            _ => {}
        }
    }
}

impl PlyElement for Skipped {
    fn set_scalar(&mut self, _: &str, _: f64, _: f64) {}

    fn set_list(&mut self, _: &str, _: Vec<f64>) {}
}

impl PropertyAccess for PlyVertex {
    fn new() -> Self {
        Self::default()
    }

    fn set_property(&mut self, name: &str, property: Property) -> PropertyAccessResult {
        set_property(self, name, property)
    }
}

impl PropertyAccess for PlyFace {
    fn new() -> Self {
        Self::default()
    }

    fn set_property(&mut self, name: &str, property: Property) -> PropertyAccessResult {
        set_property(self, name, property)
    }
}

impl PropertyAccess for Skipped {
    fn new() -> Self {
        Self
    }
}

/// The value of a full channel of a color. Colors of whole numbers have the range of their type.
pub(super) const fn full_channel(scalar: &ScalarType) -> f64 {
    match scalar {
        ScalarType::Char => 127.0,
        ScalarType::Short => 32767.0,
        ScalarType::UShort => 65535.0,
        ScalarType::UChar | ScalarType::Int | ScalarType::UInt => 255.0,
        ScalarType::Float | ScalarType::Double => 1.0,
    }
}

fn set_property(element: &mut impl PlyElement, name: &str, property: Property) -> PropertyAccessResult {
    fn to_f64<T: Into<f64>>(list: Vec<T>) -> Vec<f64> {
        list.into_iter().map(Into::into).collect()
    }
    let (value, scalar) = match property {
        Property::Char(value) => (f64::from(value), ScalarType::Char),
        Property::UChar(value) => (f64::from(value), ScalarType::UChar),
        Property::Short(value) => (f64::from(value), ScalarType::Short),
        Property::UShort(value) => (f64::from(value), ScalarType::UShort),
        Property::Int(value) => (f64::from(value), ScalarType::Int),
        Property::UInt(value) => (f64::from(value), ScalarType::UInt),
        Property::Float(value) => (f64::from(value), ScalarType::Float),
        Property::Double(value) => (value, ScalarType::Double),
        list => {
            let values = match list {
                Property::ListChar(list) => to_f64(list),
                Property::ListUChar(list) => to_f64(list),
                Property::ListShort(list) => to_f64(list),
                Property::ListUShort(list) => to_f64(list),
                Property::ListInt(list) => to_f64(list),
                Property::ListUInt(list) => to_f64(list),
                Property::ListFloat(list) => to_f64(list),
                Property::ListDouble(list) => list,
                _ => return PropertyAccessResult::UnsupportedType,
            };
            element.set_list(name, values);
            return PropertyAccessResult::Set;
        }
    };
    element.set_scalar(name, value, full_channel(&scalar));
    PropertyAccessResult::Set
}
