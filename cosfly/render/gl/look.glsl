// Light and air of a Look: fair weather by day. weather.glsl stands in its place where there is weather.
const vec3 sun_light = vec3(2.35, 2.12, 1.75), sky_light = vec3(0.48, 0.56, 0.68), ground_light = vec3(0.27, 0.25, 0.22);

// What is left of a colour behind so many metres of air.
float seen_through(float distance_m) {
    float far = distance_m / haze_m;
    return exp(-far * sqrt(far));
}
vec3 horizon_color() { return vec3(0.66, 0.75, 0.84); }
vec3 sky_gradient(vec3 d) {
    float up = clamp(d.z, 0.0, 1.0);
    vec3 sky = mix(horizon_color(), vec3(0.16, 0.34, 0.66), 1.0 - exp(-3.2 * up));
    float near_sun = max(dot(d, sun_direction), 0.0);
    return sky + vec3(1.0, 0.85, 0.6) * (0.18 * pow(near_sun, 24.0) + 0.06 * pow(near_sun, 4.0));
}
