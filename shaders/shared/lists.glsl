// Blended fragments by pixel, and what is known of all of them. Twin: `Ledger` in src/render/lists.rs.
//   counts   [height][width]  R32UI: blended fragments of the pixel
//   ends     [height][width]  R32UI: where the pixel's next record goes
//   records  [budget]         depth, as the bits of a float from 0 to 1, which sort like it; and the triangle's place plus
//                             one, above four bits of the samples that it covers. Nearer first; of one depth, later first.
layout(r32ui, binding = 1) uniform uimage2D counts;
layout(r32ui, binding = 2) uniform uimage2D ends;
layout(std430, binding = 3) buffer Ledger {
    uint total[2];       // fragments: low and high word
    uint deepest;        // of the pixel with the most
    uint most;           // records that a pixel may have
    uint used;           // records that are given out
    uint budget;         // records that there are
    uint commands[10];   // two draws of the turn for pixels with more than they may have
    uint bins[BINS];     // pixels with 1, 2, 3 ... fragments; the last bin has those with more, too
} ledger;
const uint ALL = 0xFFFFFFFFu;
