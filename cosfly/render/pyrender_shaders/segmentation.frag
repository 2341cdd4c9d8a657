#version 330 core
uniform vec3 color;      // which picture: red 1 tags, red 0.5 colours, red 0 the bits of the depth

in float depth_m;
flat in vec3 tag;
flat in vec3 paint;

out vec4 pixel;

void main() {
    if (color.r > 0.75) {
        pixel = vec4(tag / 255.0, 0.0);   // alpha 0: something stands here; the background's is 1
    } else if (color.r > 0.25) {
        pixel = vec4(paint, 1.0);
    } else {
        uint bits = floatBitsToUint(depth_m);
        pixel = vec4(bits & 255u, (bits >> 8) & 255u, (bits >> 16) & 255u, bits >> 24) / 255.0;
    }
}
