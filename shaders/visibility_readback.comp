// Copies the id of the first sample of each pixel to a buffer, top row first.
//   ids      (in)   [height][width][SAMPLES]  R32UI, bottom row first
//   ids_out  (out)  [height][width]
layout(local_size_x = WORKGROUP_SIZE) in;
layout(std430, binding = 0) writeonly buffer Pixels { uint ids_out[]; };

void main() {
    ivec2 size = id_image_size();
    ivec2 pixel = image_pixel();
    if (pixel.x >= size.x) return;
    ids_out[uint(size.y - 1 - pixel.y) * uint(size.x) + uint(pixel.x)] = load_id(pixel, 0);
}
