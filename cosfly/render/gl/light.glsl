// Noise and the final tone: shared by the sky and the scene. look.glsl or weather.glsl follows.
uniform vec3 sun_direction;       // towards the sun
uniform float haze_m;             // distance at which haze hides about two thirds
uniform float exposure;

const uint STEP_X = 1597334677u, STEP_Y = 3812015801u;
float bits_to_share(uint h) {
    h = (h ^ (h >> 15)) * 2246822519u;
    return float(int((h ^ (h >> 13)) >> 8)) * (1.0 / 16777216.0);   // a signed number converts in one instruction
}
float hash21(vec2 p) {
    uvec2 u = uvec2(ivec2(floor(p)));
    return bits_to_share(u.x * STEP_X ^ u.y * STEP_Y);
}
float noise2(vec2 p) {
    vec2 i = floor(p), f = p - i;
    uvec2 u = uvec2(ivec2(i)) * uvec2(STEP_X, STEP_Y), v = u + uvec2(STEP_X, STEP_Y);
    f = f * f * (3.0 - 2.0 * f);
    return mix(mix(bits_to_share(u.x ^ u.y), bits_to_share(v.x ^ u.y), f.x), mix(bits_to_share(u.x ^ v.y), bits_to_share(v.x ^ v.y), f.x), f.y);
}
float noise3(vec3 p) {
    float z = floor(p.z), f = p.z - z;
    return mix(noise2(p.xy + 37.0 * z), noise2(p.xy + 37.0 * (z + 1.0)), f * f * (3.0 - 2.0 * f));
}

vec3 toned(vec3 linear_color) {
    vec3 x = linear_color * exposure;
    x = (x * (2.51 * x + 0.03)) / (x * (2.43 * x + 0.59) + 0.14);   // Narkowicz's fit of the ACES curve
    vec3 a = sqrt(clamp(x, 0.0, 1.0)), b = sqrt(a), c = sqrt(b);                 // sRGB's curve from square roots, error < 0.003
    return 0.585122381 * a + 0.783140355 * b - 0.368262736 * c;
}
