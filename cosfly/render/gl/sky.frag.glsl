in vec2 v_pixel_share;
uniform mat3 world_from_camera;
uniform vec4 lens;
uniform vec2 image_size;
uniform float sky_depth_m;
uniform uint sky_tag;

layout(location = 0) out vec4 out_color;
layout(location = 1) out float out_depth;
layout(location = 2) out uint out_tag;

void main() {
    vec2 pixel = v_pixel_share * image_size;
    vec3 d = normalize(world_from_camera * vec3((pixel - lens.zw) / lens.xy, 1.0));
    vec3 sky = sky_gradient(d);
    if (d.z > 0.02) {
        vec2 p = d.xy / (d.z + 0.08) * 2.2;
        float n = 0.55 * noise2(p) + 0.28 * noise2(p * 2.13 + 7.0) + 0.14 * noise2(p * 4.4 + 3.0) + 0.07 * noise2(p * 9.1);
        float cover = smoothstep(0.54, 0.78, n) * smoothstep(0.02, 0.22, d.z);
        vec3 cloud = mix(vec3(1.05, 1.03, 1.0), vec3(0.72, 0.76, 0.82), smoothstep(0.62, 0.92, n));
        sky = mix(sky, cloud, 0.85 * cover);
    }
    sky += vec3(8.0, 7.0, 5.0) * smoothstep(0.9993, 0.9998, dot(d, sun_direction));
    out_color = vec4(toned(sky), 1.0);
    out_depth = sky_depth_m;
    out_tag = sky_tag;
}
