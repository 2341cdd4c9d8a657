// Streaks of falling drops over the finished picture: cylinders round the camera, each with its drops, hidden by what stands nearer.
in vec2 v_pixel_share;
uniform mat3 world_from_camera;
uniform vec4 lens;
uniform vec2 image_size;
uniform float precipitation;      // 0 to 1
uniform float rain_phase;
uniform vec3 rain_color;          // as it is on the screen
uniform vec2 wind;                // m to the side for each m of fall
uniform sampler2D depth_map;

layout(location = 0) out vec4 out_color;

void main() {
    vec2 pixel = v_pixel_share * image_size;
    vec3 in_camera = vec3((pixel - lens.zw) / lens.xy, 1.0);
    vec3 d = world_from_camera * in_camera;                                      // for one metre of depth
    float depth = texelFetch(depth_map, ivec2(pixel), 0).r;
    float flat_length = length(d.xy - wind * d.z), alpha = 0.0;
    vec2 direction = d.xy - wind * d.z;                                          // in axes that lean as the rain does
    float around = atan(direction.y, direction.x);
    for (int layer = 0; layer < 6; layer++) {
        float radius = 1.6 * pow(1.75, float(layer)), k = radius / max(flat_length, 1e-3);   // depth at which the ray meets it
        if (k > depth) break;
        float pixel_m = k / lens.x, z = d.z * k;
        float num_columns = floor(6.2832 * radius / (0.10 + 0.035 * radius)), u = (around / 6.2832 + 0.5) * num_columns;
        float column = floor(u), length_m = 0.55 + 0.35 * precipitation, gap_m = length_m * (5.0 - 2.4 * precipitation);
        float shift = hash21(vec2(column, float(layer) * 131.0 + 17.0));
        float v = z / gap_m + shift * 37.0 + rain_phase * (251.0 + 17.0 * float(layer)), cell = floor(v);
        float chance = hash21(vec2(column + 71.0 * float(layer), cell + floor(rain_phase * 4093.0)));
        if (chance > 0.15 + 0.85 * precipitation) continue;
        float middle = 0.25 + 0.5 * fract(chance * 91.7), across = abs(fract(u) - middle) * 6.2832 * radius / num_columns;
        float width_m = max(0.0022, 0.75 * pixel_m), part = fract(v) * gap_m / length_m;
        if (part > 1.0) continue;
        float body = smoothstep(width_m, 0.35 * width_m, across) * smoothstep(0.0, 0.3, part) * smoothstep(1.0, 0.7, part);
        alpha = max(alpha, body * min(1.0, 0.0055 / width_m) * smoothstep(0.25, 0.8, flat_length));
    }
    out_color = vec4(rain_color, clamp((0.30 + 0.28 * precipitation) * alpha, 0.0, 1.0));
}
