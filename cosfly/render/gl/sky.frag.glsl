in vec2 v_pixel_share;
uniform mat3 world_from_camera;
uniform vec4 lens;
uniform vec2 image_size;
uniform float sky_depth_m;
uniform uint sky_tag;
#ifdef WEATHER
uniform vec3 disc_light;          // of the sun's or the moon's disc
uniform float disc_size;          // cosine of its radius
uniform float stars;
#endif

layout(location = 0) out vec4 out_color;
layout(location = 1) out float out_depth;
layout(location = 2) out uint out_tag;

void main() {
    vec2 pixel = v_pixel_share * image_size;
    vec3 d = normalize(world_from_camera * vec3((pixel - lens.zw) / lens.xy, 1.0));
    vec3 sky = sky_gradient(d);
#ifdef WEATHER
    float covered = 0.0;
    if (d.z > 0.0) {
        vec2 p = d.xy / (d.z + 0.08) * 2.2;
        float n = 0.55 * noise2(p) + 0.28 * noise2(p * 2.13 + 7.0) + 0.14 * noise2(p * 4.4 + 3.0) + 0.07 * noise2(p * 9.1);
        float low = 0.80 - 0.62 * cloudiness;
        covered = smoothstep(low, low + 0.22, n) * smoothstep(0.0, 0.12 - 0.08 * cloudiness, d.z);
        sky += stars * step(0.9985, hash21(floor(d.xy / (d.z + 0.4) * 420.0))) * smoothstep(0.05, 0.3, d.z);
        vec3 cloud = mix(cloud_light, cloud_shade, smoothstep(low + 0.06, low + 0.36, n));
        cloud += 0.6 * sun_glow * pow(max(dot(d, sun_direction), 0.0), 6.0);
        vec3 deck = mix(cloud_light, cloud_shade, 0.35 + 0.5 * n) * mix(1.0, 0.82, d.z);
        sky = mix(sky, mix(cloud, deck, overcast), max((0.9 - 0.2 * (1.0 - overcast)) * covered, overcast * 0.95));
    }
    float open = (1.0 - overcast) * (1.0 - covered);
    sky += disc_light * open * open * smoothstep(disc_size, disc_size + 0.0004, dot(d, sun_direction));
    // Fog is a layer of a hundred metres: overhead the sky is seen through that, at the horizon through kilometres.
    float through_m = 110.0 / max(d.z + 0.012, 0.02);
    sky = mix(fog_color, sky, exp(-fog.x * max(through_m - fog.y, 0.0)));
#else
    if (d.z > 0.02) {
        vec2 p = d.xy / (d.z + 0.08) * 2.2;
        float n = 0.55 * noise2(p) + 0.28 * noise2(p * 2.13 + 7.0) + 0.14 * noise2(p * 4.4 + 3.0) + 0.07 * noise2(p * 9.1);
        float cover = smoothstep(0.54, 0.78, n) * smoothstep(0.02, 0.22, d.z);
        vec3 cloud = mix(vec3(1.05, 1.03, 1.0), vec3(0.72, 0.76, 0.82), smoothstep(0.62, 0.92, n));
        sky = mix(sky, cloud, 0.85 * cover);
    }
    sky += vec3(8.0, 7.0, 5.0) * smoothstep(0.9993, 0.9998, dot(d, sun_direction));
#endif
    out_color = vec4(toned(sky), 1.0);
#ifdef WEATHER
    out_color.rgb = noised(out_color.rgb);
#endif
    out_depth = sky_depth_m;
    out_tag = sky_tag;
}
