uniform mat3 camera_from_world;   // OpenCV camera: x right, y down, z forward
uniform vec3 camera_position;
uniform vec4 lens;                // fx, fy, cx, cy in pixels
uniform vec2 image_size;
uniform vec2 clip_m;              // near, far

out vec3 v_local;                 // m, in the part's axes
out vec3 v_view;                  // from the camera, in the part's axes
out vec3 v_local_normal;
out vec3 v_world;
out vec3 v_normal;
out float v_depth;
#ifdef SNAPS
out vec3 v_from_camera;           // in the world's axes, where most planes are even
#endif
flat out vec3 f_half;
flat out vec4 f_color;
flat out uint f_tag;

void main() {
    v_local = in_position * in_half;
    v_world = in_center + turned(in_quaternion, v_local);
    v_local_normal = normalize(in_normal / in_half);
    v_normal = turned(in_quaternion, v_local_normal);
    v_view = turned_back(in_quaternion, v_world - camera_position);
    f_half = in_half;
    f_color = in_color;
    f_tag = in_tag;
    vec3 from_camera = in_center - camera_position + turned(in_quaternion, v_local), c = camera_from_world * from_camera;
    v_depth = c.z;
#ifdef SNAPS
    v_from_camera = from_camera;
#endif
    // Image row 0 is the top: y is not flipped, so that the buffers need no flipping after reading.
    float n = clip_m.x, f = clip_m.y;
    gl_Position = vec4(2.0 * (lens.x * c.x + lens.z * c.z) / image_size.x - c.z,
                       2.0 * (lens.y * c.y + lens.w * c.z) / image_size.y - c.z,
                       (f + n) / (f - n) * c.z - 2.0 * f * n / (f - n) / (1.0 - in_bias), c.z);   // as if nearer by the bias
}
