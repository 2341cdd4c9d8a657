// Factors on the colours of a finished picture where a person keeps sun and sky from the ground: one capsule, drawn over its own rectangle.
uniform mat3 world_from_camera;
uniform vec3 camera_position;
uniform vec4 lens;
uniform sampler2D depth_map;
uniform usampler2D tag_map;
uniform uint person_kind;
uniform sampler2DShadow shadow_map;
uniform mat4 shadow_from_world;
uniform vec3 hip;
uniform vec3 capsule;             // lower and upper end from the hip, radius

layout(location = 0) out vec4 out_color;

const vec3 UP = vec3(0.0, 0.0, 1.0);
const float GROUND_ALBEDO = 0.25; // the factor is the change of this colour

// The ray from p to the sun against the capsule: 0 in its shadow, 1 outside.
float lets_sun(vec3 p) {
    vec3 u = (capsule.y - capsule.x) * UP, w = p - hip - capsule.x * UP;
    float uu = dot(u, u), us = dot(u, sun_direction), uw = dot(u, w), sw = dot(sun_direction, w);
    float k = clamp((uw - us * sw) / max(uu - us * us, 1e-6), 0.0, 1.0);         // nearest point of the axis to the ray's line
    vec3 gap = w - k * u;
    float t = -dot(gap, sun_direction);
    return t > 0.0 ? smoothstep(0.75, 1.25, length(gap + t * sun_direction) / capsule.z) : 1.0;
}

// What stands on the map may shade the ground already.
float sun_reaches(vec3 p) {
    vec4 c = shadow_from_world * vec4(p + 0.2 * UP + 0.03 * sun_direction, 1.0);
    return any(lessThan(c.xyz, vec3(0.0))) || any(greaterThan(c.xyz, vec3(1.0))) ? 1.0 : texture(shadow_map, c.xyz);
}

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    if ((texelFetch(tag_map, pixel, 0).r & 0xffu) == person_kind) discard;       // people darken the ground, not each other
    vec3 way = world_from_camera * vec3((gl_FragCoord.xy - lens.zw) / lens.xy, 1.0) * texelFetch(depth_map, pixel, 0).r;
    vec3 p = camera_position + way, d = p - hip;
    vec3 sun = sun_light * max(sun_direction.z, 0.0) * sun_reaches(p), sky = sky_light;
#ifdef LIT
    sky += lamp_reach(p, UP);
#endif
    float open_sky = 1.0 - 0.45 * exp(-9.0 * dot(d.xy, d.xy)) * step(d.z, capsule.y);
    vec3 shaded = toned(GROUND_ALBEDO * (sun * lets_sun(p) + sky * open_sky)) / toned(GROUND_ALBEDO * (sun + sky));
    out_color = vec4(mix(vec3(1.0), shaded, seen_through(length(way))), 1.0);
}
