// Lists of blended fragments per pixel, and their counters. Twin: `OitCounters` in src/render/oit.rs.
//   counts   [height][width]  R32UI: blended fragments of the pixel
//   ends     [height][width]  R32UI: index of the pixel's next record
//   records  [budget]         depth, as the bits of a float from 0 to 1, which sort like the float; and the triangle's
//                             index plus 1, above four bits of sample coverage. Nearer first; at equal depth, later
//                             first.
layout(r32ui, binding = 1) uniform uimage2D fragment_counts;
layout(r32ui, binding = 2) uniform uimage2D cursors;
layout(std430, binding = 3) buffer OitCounters {
    uint total[2];       // fragments: low and high word
    uint max_per_pixel;        // fragments of the pixel with the most
    uint per_pixel_limit;           // maximum number of records per pixel
    uint allocated;           // allocated records
    uint budget;         // capacity in records
    uint commands[10];   // two indirect draws of the last phase, for pixels above the maximum
    uint bins[BINS];     // pixels with 1, 2, 3 ... fragments; the last bin also counts those with more
} counters;
const uint UNBOUNDED = 0xFFFFFFFFu;
