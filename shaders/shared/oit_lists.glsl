// Lists of blended fragments per pixel, and their counters. Twin: `OitCounters` in src/render/layout/oit.rs.
//   fragment_counts  [height][width]  R32UI: blended fragments of the pixel
//   cursors          [height][width]  R32UI: index of the first record of the pixel's list that is not filled yet
//   records          [budget][2]      depth; triangle index plus 1 in the upper 28 bits, sample coverage in the lower 4
// The depth is stored as the bits of 1 minus those of a float from 1 (near) to 0 (far). The bits have the same order as
// the float, so the difference increases with the distance. A sorted list begins with the nearest record; at equal
// depth, with the latest triangle.
layout(r32ui, binding = 1) uniform uimage2D fragment_counts;
layout(r32ui, binding = 2) uniform uimage2D cursors;
layout(std430, binding = 3) buffer OitCounters {
    uint fragment_total[2];  // fragments of the frame: low and high word
    uint max_per_pixel;      // largest number of fragments of a pixel
    uint per_pixel_limit;    // maximum number of records per pixel; UNBOUNDED without a limit
    uint allocated;          // allocated records
    uint budget;             // capacity of `records`
    uint commands[10];       // two indirect draws, 5 words each, of the last gather phase
    uint bins[BINS];         // pixels with 1, 2, 3 ... fragments; the last bin also counts pixels with more
} counters;
const uint UNBOUNDED = 0xFFFFFFFFu; // no limit; also the depth of an empty record
