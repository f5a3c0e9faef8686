// A dispatch over a band: rows of an image that are processed without a break.
// Twin: `Program::set_first_row` in src/render/device/gl/object.rs.
layout(location = 2) uniform int first_row;  // of the band; row 0 is the bottom row of the image

// Pixel of this lane in the image.
ivec2 image_pixel() { return ivec2(gl_GlobalInvocationID.xy) + ivec2(0, first_row); }
