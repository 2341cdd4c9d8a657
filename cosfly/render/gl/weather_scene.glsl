// What weather does to a surface: water on it, street lamps over it, windows lit behind it. Follows the functions of weather.glsl.
uniform sampler2D lamp_map;       // light of street lamps on the ground, and their height, m relative to the origin
uniform vec4 lamp_area;           // low x, low y, 1 / size x, 1 / size y
uniform vec4 lamps[16];           // those nearest to the camera: place, strength
uniform int num_lamps;
uniform float penumbra_m;         // width of a shadow's border
uniform float shadow_texel_m;

// The shadow map round a place: clouds spread the sun, and its shadows have wide borders.
float soft_shadow(sampler2DShadow map, mat4 map_from_world, vec3 p, vec3 n) {
    vec4 c = map_from_world * vec4(p + (0.06 + 1.2 * shadow_texel_m) * n + 0.03 * sun_direction, 1.0);
    if (any(lessThan(c.xyz, vec3(0.0))) || any(greaterThan(c.xyz, vec3(1.0)))) return 1.0;
    vec2 reach = penumbra_m * vec2(length(map_from_world[0].xy), length(map_from_world[0].xy)) + 0.5 / vec2(textureSize(map, 0));
    float sum = texture(map, c.xyz);
#ifdef SOFT
    const vec2 ring[5] = vec2[](vec2(1.0, 0.0), vec2(0.31, 0.95), vec2(-0.81, 0.59), vec2(-0.81, -0.59), vec2(0.31, -0.95));
    for (int i = 0; i < 5; i++) sum += texture(map, c.xyz + vec3(ring[i] * reach, 0.0));
    sum /= 6.0;
#endif
    return sum;
}

#ifdef LIT
// Light of the street lamps on a surface: what looks down gets none, what stands over the lamps less and less.
vec3 lamp_reach(vec3 p, vec3 n) {
    vec2 found = texture(lamp_map, (p.xy + 0.8 * n.xy - lamp_area.xy) * lamp_area.zw).rg;
    float over = max(p.z - found.y + 0.5, 0.0);
    return lamp_light * found.x * (0.6 + 0.4 * n.z) * exp(-0.7 * over);
}

// Light from behind a pane; id in [0, 1) is the window's.
vec3 lit_room(float id, bool is_shop) {
    float chance = fract(id * 57.7), shade = 0.45 + 0.75 * fract(id * 23.1);
    float is_lit = step(chance, is_shop ? 0.72 : 0.36);
    vec3 warm = mix(vec3(1.0, 0.62, 0.30), vec3(0.95, 0.88, 0.78), step(0.7, fract(id * 131.3)) * 0.8);
    return lights_on * is_lit * shade * (is_shop ? 0.75 : 0.5) * warm;
}

#endif

#ifdef WET
// Rings of drops and the shimmer of running water, as a slant of the surface.
vec2 ripples(vec2 p, float w) {
    float fade = clamp(1.3 - 9.0 * w, 0.0, 1.0);
    if (fade <= 0.0) return vec2(0.0);
    vec2 cell = floor(p * 3.0), q = fract(p * 3.0) - 0.5;
    float start = hash21(cell + floor(rain_phase * 977.0));
    q += 0.5 * (vec2(fract(start * 17.3), fract(start * 41.9)) - 0.5);
    float r = length(q) + 1e-4;
    float ring = sin(40.0 * (r - 0.45 * start)) * exp(-60.0 * pow(r - 0.45 * start, 2.0));
    return fade * (0.16 * ring * q / r + 0.05 * (vec2(noise2(p * 7.0 + 90.0 * rain_phase), noise2(p * 7.0 + 40.0 + 90.0 * rain_phase)) - 0.5));
}

// How much of what a wet surface mirrors is hidden by what stands round it: a few steps over the map of heights.
float mirrored_block(sampler2D heights, vec4 area, vec3 p, vec3 r) {
    float hidden = 0.0;
    for (int i = 0; i < 4; i++) {
        vec3 q = p + r * (2.5 + 6.0 * float(i * i));
        hidden = max(hidden, smoothstep(-1.0, 1.5, texture(heights, (q.xy - area.xy) * area.zw).r - q.z) * (1.0 - 0.12 * float(i)));
    }
    return hidden;
}

#ifdef LIT
// Lamps in a wet surface: long streaks towards the eye.
vec3 mirrored_lamps(vec3 p, vec3 r, float roughness) {
    vec3 sum = vec3(0.0);
    for (int i = 0; i < num_lamps; i++) {
        vec3 to = lamps[i].xyz - p;
        float away = dot(to, to);
        vec3 l = normalize(vec3(to.xy, 0.30 * to.z)), q = normalize(vec3(r.xy, 0.30 * r.z));
        sum += lamps[i].w * pow(max(dot(l, q), 0.0), roughness) / (1.0 + 0.004 * away) * vec3(1.0);
    }
    return sum;
}
#endif
#endif
