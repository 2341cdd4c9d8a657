// One triangle over the whole image, at the far plane.
out vec2 v_pixel_share;

void main() {
    vec2 corner = vec2((gl_VertexID == 1) ? 3.0 : -1.0, (gl_VertexID == 2) ? 3.0 : -1.0);
    v_pixel_share = 0.5 * corner + 0.5;
    gl_Position = vec4(corner, 1.0, 1.0);
}
