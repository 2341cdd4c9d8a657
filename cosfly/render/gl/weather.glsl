// Light and air under weather, in the place of the constants of look.glsl: uniforms that weather_pass.py makes of the six knobs.
uniform vec3 sun_light;           // of the sun, or at night of the moon
uniform vec3 sky_light;           // from above
uniform vec3 ground_light;        // from below
uniform vec3 horizon;
uniform vec3 zenith;
uniform vec3 sun_glow;            // round the sun and over the horizon below it
uniform vec3 fog_color;
uniform vec2 fog;                 // extinction per metre, distance at which it begins
uniform float overcast;           // 0 a sky with single clouds, 1 one grey cover
uniform float cloudiness;         // 0 to 1
uniform vec3 cloud_light;         // lit side of a cloud
uniform vec3 cloud_shade;
uniform float wetness;            // of the ground
uniform float puddles;
uniform float lights_on;          // street lamps and windows
uniform vec3 lamp_light;          // on the ground under a lamp
uniform float rain_phase;         // where drops and the sensor's noise fall in this frame

vec3 horizon_color() { return fog_color; }
vec3 sky_gradient(vec3 d) {
    float up = clamp(d.z, 0.0, 1.0);
    vec3 sky = mix(horizon, zenith, 1.0 - exp(-3.2 * up));
    float near_sun = max(dot(d, sun_direction), 0.0), toward = near_sun * near_sun;
    return sky + sun_glow * (0.5 * toward * toward * toward * (1.0 - up) * (1.0 - up) + 0.3 * pow(near_sun, 24.0));
}
// What is left of a colour behind so many metres of air and fog.
float seen_through(float distance_m) {
    float far = distance_m / haze_m;
    return exp(-far * sqrt(far) - fog.x * max(distance_m - fog.y, 0.0));
}
// Noise of a sensor, one level of 255: without it fog would be bands and flat surfaces.
vec3 noised(vec3 screen) { return screen + (hash21(gl_FragCoord.xy + floor(rain_phase * 9973.0)) - 0.5) * (2.0 / 255.0); }
