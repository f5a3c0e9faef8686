// Lists of blended fragments per pixel, and their counters. Twin: `Ledger` in src/render/lists.rs.
//   counts   [height][width]  R32UI: blended fragments of the pixel
//   ends     [height][width]  R32UI: index of the pixel's next record
//   records  [budget]         depth, as the bits of a float from 0 to 1, which sort like the float; and the triangle's
//                             index plus 1, above four bits of sample coverage. Nearer first; at equal depth, later
//                             first.
layout(r32ui, binding = 1) uniform uimage2D counts;
layout(r32ui, binding = 2) uniform uimage2D ends;
layout(std430, binding = 3) buffer Ledger {
    uint total[2];       // fragments: low and high word
    uint deepest;        // fragments of the pixel with the most
    uint most;           // maximum number of records per pixel
    uint used;           // allocated records
    uint budget;         // capacity in records
    uint commands[10];   // two indirect draws of the last phase, for pixels above the maximum
    uint bins[BINS];     // pixels with 1, 2, 3 ... fragments; the last bin also counts those with more
} ledger;
const uint ALL = 0xFFFFFFFFu;
