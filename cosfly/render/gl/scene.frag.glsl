in vec3 v_local;
in vec3 v_view;
in vec3 v_local_normal;
in vec3 v_world;
in vec3 v_normal;
in float v_depth;
#ifdef SNAPS
in vec3 v_from_camera;
uniform vec4 lens;
uniform mat3 camera_from_world;
#endif
flat in vec3 f_half;
flat in vec4 f_color;
flat in uint f_tag;

uniform vec3 camera_position;
uniform vec2 world_offset;            // scene origin modulo the pattern size, so that patterns do not move with the map
uniform sampler2DShadow shadow_map;
uniform mat4 shadow_from_world;
uniform sampler2D height_map;         // blurred height of what stands around, m relative to the origin
uniform vec4 height_area;             // low x, low y, 1 / size x, 1 / size y
uniform float ground_z;

layout(location = 0) out vec4 out_color;
layout(location = 1) out float out_depth;
layout(location = 2) out uint out_tag;

// The numbers of parts.py. MATERIAL is one of them: this text is compiled once for each, because llvmpipe runs both sides of
// every branch, and one program for all materials costs five times as much.
const int PLAIN = 0, FACADE = 1, ROAD = 2, SIDEWALK = 3, GRASS = 4, LEAVES = 5, BARK = 6, CAR_PAINT = 7, CABIN = 8, RUBBER = 9,
    METAL = 10, BRICK = 11, WATER = 12, FENCE = 13, ROAD_LINE = 14, LAMP = 15, GRAVEL = 16, SIGNAL = 17, BUS = 18, CLOTH = 19,
    CONCRETE = 20, TILES = 21;
const int material = MATERIAL;

// Depth of the surface at the middle of the pixel. Hardware draws triangles as if their corners stood on a grid of 1 / 256 pixel, so that what it
// interpolates is of a place beside the middle, though of the same plane; the plane is cut with the pixel's ray. llvmpipe has no such grid.
float depth_here() {
#ifdef SNAPS
    vec3 ray = vec3((gl_FragCoord.xy - lens.zw) / lens.xy, 1.0) * camera_from_world;
    vec3 plane = cross(dFdx(v_from_camera), dFdy(v_from_camera));
    float depth = dot(plane, v_from_camera) / dot(plane, ray);
    return abs(depth - v_depth) < 0.02 * v_depth ? depth : v_depth;   // of a plane seen edge-on nothing is cut
#else
    return v_depth;
#endif
}

struct Surface { vec3 albedo; vec3 normal; float mirror; float shade; vec3 glow; };

// Grain of about 1 / frequency metres, without visible squares from close by; 0.5 on average.
float grain(vec2 p, float frequency, float w) {
    float fade = clamp(1.4 - 0.25 * frequency * w, 0.0, 1.0), close = clamp(0.8 - 2.5 * frequency * w, 0.0, 1.0);
    return 0.5 + fade * (mix(hash21(p * frequency), noise2(p * frequency), close) - 0.5) + 0.5 * close * (hash21(p * frequency * 4.3) - 0.5);
}

// Share of a pixel of width w at x that lies in [low, high]: a stripe without aliasing.
float stripe(float x, float low, float high, float w) {
    return clamp((min(x + 0.5 * w, high) - max(x - 0.5 * w, low)) / w, 0.0, 1.0);
}
// The same for stripes of width `part` at every whole number.
float stripes(float x, float part, float w) {
    float a = x - 0.5 * w, b = x + 0.5 * w;
    float sa = floor(a) * part + min(fract(a), part), sb = floor(b) * part + min(fract(b), part);
    return clamp((sb - sa) / w, 0.0, 1.0);
}

vec3 brick_pattern(vec2 p, vec2 w, vec3 color) {
    float row = floor(p.y / 0.075);
    float x = p.x / 0.24 + 0.5 * mod(row, 2.0);
    float joint = max(stripes(p.y / 0.075, 0.14, w.y / 0.075), stripes(x, 0.06, w.x / 0.24));
    float fade = clamp(1.5 - 18.0 * max(w.x, w.y), 0.0, 1.0);
    float tone = mix(0.5, hash21(vec2(floor(x), row)), fade);
    return mix(color * (0.82 + 0.36 * tone), vec3(0.45, 0.42, 0.38), 0.6 * joint);
}

// Distance to the nearest edge of the top face of a box. A mesh has no seed of 1 or more: its outline is not that of its part.
float to_edge(vec3 p, vec3 h) { return material == SIDEWALK || f_color.a >= 1.0 ? min(h.x - abs(p.x), h.y - abs(p.y)) : 99.0; }

void roof(inout Surface s, vec3 p, vec3 h, float seed, float w) {
    float edge = to_edge(p, h);
    float kind = fract(seed * 31.7);
    vec3 base = kind < 0.4 ? vec3(0.27, 0.26, 0.25) : kind < 0.7 ? vec3(0.16, 0.165, 0.175) : kind < 0.85 ? vec3(0.36, 0.33, 0.29) : vec3(0.20, 0.25, 0.15);
    float weathered = noise2(p.xy * 0.35 + seed * 50.0);
    s.albedo = base * (0.75 + 0.35 * weathered + 0.3 * (grain(p.xy, 22.0, w) - 0.5));
    if (kind >= 0.4 && kind < 0.7) s.albedo *= 1.0 - 0.25 * stripes(p.x, 0.05, w);          // sheets of roofing felt
    if (min(h.x, h.y) > 3.0) {
        vec2 cell = floor(p.xy / 4.5), q = fract(p.xy / 4.5) * 4.5 - 2.25;
        float a = hash21(cell + floor(seed * 400.0));
        vec2 size = vec2(0.5 + 0.9 * fract(a * 17.0), 0.5 + 0.7 * fract(a * 43.0));
        if (a > 0.62 && edge > 1.6) {
            vec2 lean = -sun_direction.xy * 0.7;
            float shadow = stripe(q.x - lean.x, -size.x, size.x, w) * stripe(q.y - lean.y, -size.y, size.y, w);
            float box = stripe(q.x, -size.x, size.x, w) * stripe(q.y, -size.y, size.y, w);
            s.albedo *= 1.0 - 0.6 * shadow;
            vec3 top = a > 0.9 ? vec3(0.10, 0.15, 0.20) : vec3(0.50, 0.51, 0.52);
            if (a <= 0.9) top *= 1.0 - 0.45 * smoothstep(0.36, 0.30, length(q)) - 0.3 * stripes(q.y * 6.0, 0.3, 6.0 * w);
            s.albedo = mix(s.albedo, top, box);
            s.mirror = a > 0.9 ? 0.3 * box : 0.0;
        }
    }
    float rim = stripe(edge, -1.0, 0.32, w);
    s.albedo *= 1.0 - 0.35 * stripe(edge, 0.32, 0.6, w);
    s.albedo = mix(s.albedo, f_color.rgb * 0.6 + 0.22, rim);
}

vec3 room_behind(float id) {
    float curtain = fract(id * 91.7);
    vec3 room = mix(vec3(0.018, 0.022, 0.028), vec3(0.10, 0.09, 0.075), step(0.62, curtain) * (0.35 + 0.65 * fract(id * 13.3)));
    return room;
}

void wall(inout Surface s, vec3 p, vec3 n, vec3 h, float seed, vec3 footprint) {
    bool along_y = abs(n.x) > abs(n.y);
    float u = along_y ? p.y : p.x, half_u = along_y ? h.y : h.x;
    float wu = along_y ? footprint.y : footprint.x, wv = footprint.z;
    float buried = max(0.0, ground_z - (v_world.z - p.z - h.z));                 // storeys are counted from the ground
    float v = p.z + h.z - buried, height = 2.0 * h.z - buried;
    vec3 view = v_view;
    float into = abs(along_y ? view.x : view.y);
    vec2 slant = vec2(along_y ? view.y : view.x, view.z) / max(into, 1e-3);      // shift per metre of depth into the wall
    float style = fract(seed * 57.3);
    vec3 base = f_color.rgb;
    float streak = noise2(vec2(u * 0.9, v * 0.12) + seed * 90.0);
    bool is_brick = seed * 12.0 - floor(seed * 12.0) < 2.0 && base.r > 1.55 * base.g;
    s.albedo = is_brick ? brick_pattern(vec2(u, v), vec2(wu, wv), base) : base * (0.97 + 0.06 * hash21(vec2(u, v) * 9.0));
    s.albedo *= 0.86 + 0.22 * streak;
    s.albedo *= 1.0 - 0.22 * exp(-v * 1.6);                                      // splashed foot of the wall
    if (2.0 * half_u < 1.6 || height < 2.4) return;

    float num_floors = max(1.0, floor(height / 3.2 + 0.35)), floor_m = height / num_floors;
    float bay_wish = style < 0.3 ? 2.5 : style < 0.6 ? 3.2 : style < 0.8 ? 1.6 : 4.4;
    float num_bays = max(1.0, floor(2.0 * half_u / bay_wish)), bay_m = 2.0 * half_u / num_bays;
    float level = min(floor(v / floor_m), num_floors - 1.0), bay = floor((u + half_u) / bay_m);
    vec2 q = vec2(u + half_u - bay * bay_m, v - level * floor_m);                // in the cell, m
    float id = hash21(vec2(bay + (along_y ? 300.0 : 0.0) + (n.x + n.y > 0.0 ? 77.0 : 0.0), level + floor(seed * 900.0)));
    bool is_ground = level < 0.5 && num_floors > 1.5;
    bool is_shop = is_ground && style > 0.25 && fract(seed * 7.1) > 0.35;
    // The opening in the cell: left, right, bottom, top in metres.
    vec4 o = style < 0.3 ? vec4(0.28 * bay_m, 0.72 * bay_m, 0.9, floor_m - 0.5)
           : style < 0.6 ? vec4(0.2 * bay_m, 0.8 * bay_m, 0.85, floor_m - 0.45)
           : style < 0.8 ? vec4(0.05, bay_m - 0.05, 1.0, floor_m - 0.35)
                         : vec4(0.12 * bay_m, 0.88 * bay_m, 0.7, floor_m - 0.4);
    float reveal = style < 0.6 ? 0.2 : 0.1;
    if (is_shop) { o = vec4(0.06 * bay_m, 0.94 * bay_m, 0.45, floor_m - 0.75); reveal = 0.3; }
    bool is_door = is_ground && !is_shop && abs(bay - floor(0.5 * num_bays)) < 0.5;
    if (is_door) { o = vec4(0.5 * bay_m - 0.55, 0.5 * bay_m + 0.55, 0.0, 2.25); reveal = 0.25; }
    if (is_shop) s.albedo = mix(s.albedo, vec3(0.10, 0.10, 0.11) + 0.12 * fract(seed * vec3(3.1, 5.7, 9.2)), 0.75);
    float opening = stripe(q.x, o.x, o.y, wu) * stripe(q.y, o.z, o.w, wv);
    // Frames, sills and lintels stand out of the wall a little: lighter, with a thin shadow under them.
    if (!is_shop && style < 0.6) {
        float frame = stripe(q.x, o.x - 0.1, o.y + 0.1, wu) * stripe(q.y, o.z - 0.12, o.w + 0.16, wv);
        s.albedo = mix(s.albedo, base * 0.45 + 0.38, 0.65 * max(frame - opening, 0.0));
        s.albedo *= 1.0 - 0.35 * stripe(q.x, o.x - 0.1, o.y + 0.1, wu) * stripe(q.y, o.z - 0.2, o.z - 0.12, wv);
    }
    if (opening > 0.001) {
        vec2 inner = q + slant * reveal;                                         // where the ray meets the pane
        float pane = stripe(inner.x, o.x, o.y, wu) * stripe(inner.y, o.z, o.w, wv);
        vec3 jamb = base * (inner.y > o.w ? 0.28 : inner.y < o.z ? 0.75 : 0.45);
        vec3 pane_color = is_door ? vec3(0.12, 0.07, 0.04) + 0.10 * fract(seed * vec3(5.0, 9.0, 13.0)) : room_behind(id);
        float mullion = is_door ? 0.0 : max(stripe(abs(inner.x - 0.5 * (o.x + o.y)), -1.0, 0.03, wu), max(stripe(inner.x, o.x, o.x + 0.06, wu) + stripe(inner.x, o.y - 0.06, o.y, wu),
            stripe(inner.y, o.w - 0.06, o.w, wv) + stripe(inner.y, o.z, o.z + 0.06, wv)));
        vec3 frame_color = style < 0.45 ? vec3(0.62, 0.61, 0.58) : vec3(0.10, 0.10, 0.11);
        float glassy = pane * (1.0 - clamp(mullion, 0.0, 1.0));
        pane_color = mix(pane_color, frame_color, clamp(mullion, 0.0, 1.0));
        s.albedo = mix(s.albedo, mix(jamb, pane_color, pane), opening);
        s.mirror = is_door ? 0.0 : 0.9 * glassy * opening;
#ifdef LIT
        if (!is_door) s.glow += lit_room(id, is_shop) * glassy * opening * (0.75 + 0.25 * smoothstep(o.z, o.w, inner.y));
#endif
        s.shade *= 1.0 - 0.5 * opening * (1.0 - pane);
        // Panes do not stand in one plane: mirrored edges shift from window to window.
        s.normal = normalize(s.normal + 0.02 * opening * vec3(id - 0.5, fract(id * 7.0) - 0.5, fract(id * 29.0) - 0.5));
    }
    if (num_floors > 1.5 && style < 0.7) {                                       // string course over the ground floor
        float band = stripe(v, floor_m - 0.28, floor_m - 0.02, wv);
        s.albedo = mix(s.albedo, base * 0.5 + 0.3, 0.8 * band);
        s.mirror *= 1.0 - band;
    }
    if (style >= 0.8 && level > 0.5 && fract(id * 3.7) > 0.35) {                 // balconies: a slab and a rail, painted
        float rail = stripe(q.y, 0.0, 1.0, wv) * stripe(q.x, 0.08 * bay_m, 0.92 * bay_m, wu);
        s.albedo = mix(s.albedo, base * 0.55 + 0.25, 0.85 * rail * (0.25 + 0.75 * stripes(q.x / 0.12, 0.4, wu / 0.12)));
        s.albedo = mix(s.albedo, vec3(0.4), stripe(q.y, 0.0, 0.16, wv) * stripe(q.x, 0.05 * bay_m, 0.95 * bay_m, wu));
        s.mirror *= 1.0 - rail;
    }
    float cornice = stripe(height - v, 0.0, 0.45, wv);
    s.albedo = mix(s.albedo, base * 0.5 + 0.32, 0.85 * cornice);
    s.albedo *= 1.0 - 0.4 * stripe(height - v, 0.45, 0.75, wv);
    s.mirror *= 1.0 - cornice;
}

void ground_cover(inout Surface s, vec2 p, vec3 local, vec3 h, float w) {
    float fine = clamp(1.4 - 7.0 * w, 0.0, 1.0), medium = clamp(1.4 - 1.2 * w, 0.0, 1.0);
    float patches = noise2(p * 0.11);
    if (material == ROAD) {
        float worn = mix(0.5, noise2(p * 1.3), medium);
        s.albedo *= 0.78 + 0.25 * patches + 0.16 * worn + 0.42 * (grain(p, 28.0, w) - 0.5);
        float seam = smoothstep(0.03, 0.0, abs(patches - 0.62)) * medium;        // an old repair
        s.albedo *= 1.0 - 0.22 * seam * worn;
        if (f_color.a < 1.5 && h.x > 2.5 * h.y && h.y > 2.0 && h.y < 12.0) {                        // a carriageway: middle dashes and edge lines
            float a = local.x, b = local.y, wa = w, wb = w;
            float dash = stripe(abs(b), -1.0, 0.075, wb) * stripes(a / 6.0, 0.5, wa / 6.0);
            float edge = stripe(h.y - abs(b), 0.3, 0.42, wb);
            float lane = h.y > 5.5 ? stripe(abs(abs(b) - 0.5 * h.y), -1.0, 0.06, wb) * stripes(a / 9.0 + 0.3, 0.35, wa / 9.0) : 0.0;
            float paint = max(max(dash, edge), lane) * step(abs(a), h.x - h.y);
            s.albedo = mix(s.albedo, vec3(0.60, 0.60, 0.57), paint * (0.65 + 0.3 * worn));
            float track = exp(-6.0 * pow(abs(abs(abs(b) - 0.5 * h.y) - 0.75), 2.0));
            s.albedo *= 1.0 - 0.12 * track;                                      // tyres polish two tracks in each lane
        }
    } else if (material == SIDEWALK) {
        vec2 cell = floor(p / vec2(0.9, 0.6));
        float joint = max(stripes(p.x / 0.9, 0.03, w / 0.9), stripes(p.y / 0.6, 0.045, w / 0.6));
        s.albedo *= 0.86 + 0.14 * patches + 0.16 * medium * (hash21(cell) - 0.5) + 0.14 * (grain(p, 40.0, w) - 0.5);
        s.albedo *= 1.0 - 0.45 * joint;
        float edge = to_edge(local, h);                                        // the kerb
        s.albedo = mix(s.albedo, vec3(0.43, 0.42, 0.40) * (1.0 - 0.5 * stripes(p.x + p.y, 0.02, w)), 0.8 * stripe(edge, -1.0, 0.18, w));
    } else if (material == GRASS) {
        float tufts = mix(0.5, noise2(p * 2.7), medium), blades = grain(p, 26.0, w) - 0.5;
        s.albedo *= 0.7 + 0.35 * patches + 0.3 * tufts + 0.5 * blades;
        s.albedo = mix(s.albedo, vec3(0.20, 0.17, 0.085), 0.55 * smoothstep(0.55, 0.85, noise2(p * 0.045 + 11.0)));
        s.albedo += vec3(0.02, 0.03, 0.0) * noise2(p * 0.6);
    } else if (material == GRAVEL) {
        float stones = mix(0.5, hash21(p * 17.0), fine);
        s.albedo *= 0.7 + 0.25 * patches + 0.2 * mix(0.5, noise2(p * 1.7), medium) + 0.3 * stones;
    } else if (material == ROAD_LINE) {
        s.albedo *= 0.85 + 0.25 * mix(0.5, noise2(p * 3.0), medium);
    }
}

float leaf_cover(vec3 p, float w, out vec3 bump) {
    float near = clamp(1.5 - 3.0 * w, 0.0, 1.0), close = clamp(1.4 - 10.0 * w, 0.0, 1.0);
    float big = noise3(p * 1.3), small = mix(0.5, noise3(p * 5.5), near);
    float leaf = mix(0.5, 0.6 * noise3(p * 15.0) + 0.4 * noise3(p.zxy * 31.0), close);
    bump = vec3(small - 0.5, noise3(p * 4.1 + 15.0) - 0.5, 1.3 * (leaf - 0.5));
    return 0.3 * big + 0.45 * small + 0.25 * leaf;
}

float sun_reaches(vec3 p, vec3 n) {
#ifdef SHADOWS
    return soft_shadow(shadow_map, shadow_from_world, p, n);
#elif defined(WEATHER)
    return 0.0;                                                                  // no sun through these clouds
#endif
    float lift = material == LEAVES ? 0.3 : 0.09;
    vec4 c = shadow_from_world * vec4(p + lift * n + 0.03 * sun_direction, 1.0);
    if (any(lessThan(c.xyz, vec3(0.0))) || any(greaterThan(c.xyz, vec3(1.0)))) return 1.0;
    return texture(shadow_map, c.xyz);                                           // compared and blended between four texels
}

void main() {
    vec3 footprint = max(fwidth(v_local), vec3(1e-4));
    float w = max(footprint.x, max(footprint.y, footprint.z));
    vec3 n = normalize(v_local_normal);
    vec2 p = v_world.xy + world_offset;
    Surface s = Surface(f_color.rgb, normalize(v_normal), 0.0, 1.0, vec3(0.0));
    bool is_top = v_normal.z > 0.7;
    float translucent = 0.0;

    if (material == FACADE) {
        if (is_top) roof(s, v_local, f_half, fract(f_color.a), w); else if (v_normal.z > -0.7) wall(s, v_local, n, f_half, fract(f_color.a), footprint);
    } else if (material == LEAVES) {
        vec3 bump;
        float cover = leaf_cover(v_world, w, bump);
        s.normal = normalize(s.normal + 1.5 * bump);
        s.albedo *= mix(vec3(0.3, 0.36, 0.3), vec3(1.55, 1.4, 1.2), smoothstep(0.22, 0.78, cover));
        s.shade = 0.45 + 0.55 * smoothstep(-1.0, 0.7, v_local.z / f_half.z) * smoothstep(0.15, 0.6, cover);
        translucent = 0.22;
    } else if (material == ROAD || material == SIDEWALK || material == GRASS || material == GRAVEL || material == ROAD_LINE) {
        if (is_top) ground_cover(s, p, v_local, f_half, w);
        else s.albedo = material == SIDEWALK ? vec3(0.40, 0.39, 0.37) : s.albedo * 0.9;
    } else if (material == BRICK) {
        bool along_y = abs(n.x) > abs(n.y);
        vec2 q = vec2(along_y ? v_local.y : v_local.x, v_local.z + f_half.z);
        if (is_top) s.albedo = vec3(0.42, 0.40, 0.38); else s.albedo = brick_pattern(q, vec2(along_y ? footprint.y : footprint.x, footprint.z), s.albedo);
        s.albedo = mix(s.albedo, vec3(0.43, 0.41, 0.38), stripe(f_half.z - v_local.z, -1.0, 0.1, footprint.z));
        s.albedo *= 0.8 + 0.3 * noise2(q * 0.8) - 0.2 * exp(-3.0 * q.y);
    } else if (material == TILES) {                                              // courses along the eaves, every second one shifted
        float row = floor(v_local.z / 0.32);
        float x = v_local.x / 0.26 + 0.5 * mod(row, 2.0);
        float near = clamp(1.4 - 6.0 * w, 0.0, 1.0);
        s.albedo *= 0.78 + 0.22 * noise2(v_local.xz * 0.5 + 40.0 * fract(f_color.a)) + 0.3 * near * (hash21(vec2(floor(x), row)) - 0.5);
        s.albedo *= 1.0 - 0.42 * max(stripes(v_local.z / 0.32, 0.16, footprint.z / 0.32), 0.6 * stripes(x, 0.12, footprint.x / 0.26));
    } else if (material == FENCE) {
        bool along_y = abs(n.x) > abs(n.y);
        float u = along_y ? v_local.y : v_local.x, wu = along_y ? footprint.y : footprint.x;
        if (!is_top) {
            float slat = stripes(u / 0.16, 0.72, wu / 0.16);
            float tone = mix(0.5, hash21(vec2(floor(u / 0.16), 3.0)), clamp(1.3 - 5.0 * wu, 0.0, 1.0));
            s.albedo *= (0.75 + 0.5 * tone) * (0.25 + 0.75 * slat);
            s.albedo *= 1.0 - 0.3 * stripe(abs(abs(v_local.z) - 0.6 * f_half.z), -1.0, 0.05, footprint.z);
        }
    } else if (material == CABIN) {
        if (!is_top) {
            float pillar = max(stripe(abs(v_local.x), -1.0, 0.05, footprint.x) * step(0.6, abs(n.y)), stripe(f_half.z + v_local.z, -1.0, 0.05, footprint.z));
            s.albedo = mix(vec3(0.015, 0.018, 0.02), s.albedo, pillar);
            s.mirror = 0.8 * (1.0 - pillar);
        }
    } else if (material == CAR_PAINT) {
        s.mirror = 0.16;
        vec3 r = v_local / f_half;
        if (abs(r.x) > 0.93 && abs(r.y) > 0.5 && r.z > -0.1 && r.z < 0.55) s.albedo = r.x > 0.0 ? vec3(0.85, 0.85, 0.8) : vec3(0.5, 0.02, 0.02);
        if (r.z < -0.62) s.albedo = vec3(0.02);
        s.albedo *= 1.0 - 0.5 * stripe(abs(v_local.x - 0.1), -1.0, 0.012, footprint.x) * step(0.5, abs(n.y));
    } else if (material == BUS) {
        float band = stripe(v_local.z, 0.05 * f_half.z, 0.62 * f_half.z, footprint.z);
        if (!is_top) {
            float u = abs(n.x) > abs(n.y) ? v_local.y : v_local.x;
            float pane = band * (1.0 - stripes(u / 1.4, 0.07, w / 1.4));
            s.albedo = mix(s.albedo, vec3(0.015, 0.018, 0.02), pane);
            s.mirror = 0.8 * pane;
        } else s.albedo = mix(vec3(0.5), s.albedo, 0.2);
    } else if (material == RUBBER) {
        float r = length(v_local.xy) / f_half.x;
        if (abs(n.z) > 0.7 && r < 0.62) { s.albedo = vec3(0.32) * (0.6 + 0.4 * step(0.5, fract(atan(v_local.y, v_local.x) * 0.7958))); s.mirror = 0.1; }
    } else if (material == WATER) {
        float a = noise2(p * 0.8), b = noise2(p * 0.8 + 31.0), fine = clamp(1.4 - 2.0 * w, 0.0, 1.0);
        s.normal = normalize(s.normal + vec3(a - 0.5, b - 0.5, 0.0) * 0.08 * fine);
        s.mirror = is_top ? 1.0 : 0.0;
    } else if (material == LAMP) {
        s.mirror = 0.1;
    } else if (material == SIGNAL) {
        float third = v_local.z / f_half.z * 1.5;
        vec2 q = vec2(abs(n.x) > abs(n.y) ? v_local.y : v_local.x, (third - floor(third + 0.5)) * f_half.z * 0.667);
        float disc = smoothstep(0.13, 0.11, length(q)) * (is_top ? 0.0 : 1.0);
        float lit = floor(fract(f_color.a * 7.7) * 3.0) - 1.0;
        vec3 hue = third > 0.5 ? vec3(1.0, 0.08, 0.04) : third > -0.5 ? vec3(1.0, 0.6, 0.05) : vec3(0.1, 0.95, 0.35);
        s.glow = hue * disc * (abs(floor(third + 0.5) - lit) < 0.5 ? 1.0 : 0.08);
    } else if (material == BARK) {
        s.albedo *= 0.7 + 0.6 * noise2(vec2(atan(v_local.y, v_local.x) * 4.0, v_local.z * 2.0));
    } else if (material == CLOTH) {
        s.albedo *= 0.92 + 0.16 * noise3(v_local * 24.0);
    } else if (material == CONCRETE || material == PLAIN) {
        float stain = noise3(vec3(p, v_world.z) * 0.7);
        s.albedo *= 0.82 + 0.3 * stain;
        float edge = min(min(f_half.x - abs(v_local.x) + step(0.6, abs(n.x)) * 9.0, f_half.y - abs(v_local.y) + step(0.6, abs(n.y)) * 9.0), f_half.z - abs(v_local.z) + step(0.6, abs(n.z)) * 9.0);
        s.albedo *= 1.0 - 0.25 * stripe(edge, -1.0, 0.04, w);
    } else if (material == METAL) {
        s.mirror = 0.08;
    }

    vec3 geometric = normalize(v_normal);
    vec3 to_eye = normalize(camera_position - v_world);
#ifdef WET
    const bool mirrors = material == ROAD || material == SIDEWALK || material == ROAD_LINE || material == GRAVEL;   // flat and hard
    const bool is_soft = material == GRASS || material == LEAVES || material == CLOTH || material == BARK;
    const bool is_tight = material == LAMP || material == METAL || material == CAR_PAINT || material == CABIN || material == RUBBER || material == WATER;
    float wet = wetness;
    if (!is_tight) s.albedo *= 1.0 - (is_soft ? 0.28 : is_top ? 0.5 : 0.22) * wetness;
    if (mirrors) {
        float pool = puddles * smoothstep(0.50, 0.62, 0.65 * noise2(p * 0.19 + 5.0) + 0.35 * noise2(p * 0.8));
        s.albedo *= 1.0 - 0.45 * pool;
        wet *= is_top ? 0.42 + 0.58 * pool : 0.0;
        s.normal = normalize(s.normal + vec3(ripples(p, w) * (0.4 + 0.6 * pool), 0.0));
    }
#endif
#ifdef LIT
    if (material == LAMP && f_color.r > 0.5) s.glow += lights_on * vec3(2.6, 2.1, 1.35) * (v_normal.z < 0.35 ? 1.0 : 0.35);
#endif
    // Light: a warm sun, a blue sky, some light from the ground; darker near the ground between tall things.
    float facing = dot(s.normal, sun_direction);
    float sun = mix(max(facing, 0.0), 0.5 + 0.5 * facing, translucent);
    if (sun > 0.001 && (dot(geometric, sun_direction) > 0.0 || translucent > 0.0)) {
        sun *= sun_reaches(v_world, geometric);
    } else sun = 0.0;
    float around = texture(height_map, (v_world.xy - height_area.xy) * height_area.zw).r - v_world.z;
    float open_sky = 1.0 / (1.0 + 0.16 * max(around, 0.0));
    vec3 ambient = mix(ground_light, sky_light, 0.5 + 0.5 * s.normal.z) * open_sky * s.shade;
    vec3 light = sun_light * sun * mix(1.0, s.shade, 0.5) + ambient;
    vec3 lamp = vec3(0.0);
#ifdef LIT
    lamp = lamp_reach(v_world, geometric);
    light += lamp * mix(1.0, s.shade, 0.7);
#endif
    vec3 color = s.albedo * light + s.glow;
    if (s.mirror > 0.0) {
#ifdef WEATHER
        vec3 below = 0.3 * (sky_light + ground_light), beside = 0.33 * (sky_light + ground_light);
#else
        const vec3 below = vec3(0.17, 0.17, 0.155), beside = vec3(0.20, 0.19, 0.18);
#endif
        float grazing = pow(1.0 - max(dot(s.normal, to_eye), 0.0), 5.0);
        float share = s.mirror * (material == CAR_PAINT || material == METAL || material == LAMP ? 0.5 * grazing + 0.35 : 0.07 + 0.93 * grazing);
        vec3 r = reflect(-to_eye, s.normal);
        vec3 seen = r.z > 0.0 ? sky_gradient(r) * (0.75 + 0.4 * noise2(r.xy / (r.z + 0.25) * 2.5)) : below;
        seen = mix(beside, seen, smoothstep(-0.05, 0.22, r.z));
        color = mix(color, seen * (0.4 + 0.6 * open_sky), clamp(share, 0.0, 0.95));
#ifdef WEATHER
        color += sun_light * s.mirror * sun * pow(max(dot(r, sun_direction), 0.0), 90.0);
#else
        color += vec3(2.2, 2.0, 1.6) * s.mirror * sun * pow(max(dot(r, sun_direction), 0.0), 90.0);
#endif
    }
    float distance_m = length(camera_position - v_world);
#ifdef WET
    if (mirrors) {
        float share = wet * (0.05 + 0.95 * pow(1.0 - max(dot(s.normal, to_eye), 0.0), 3.6));
        vec3 r = reflect(-to_eye, s.normal);
        r.z = max(r.z, 0.02);
        float hidden = mirrored_block(height_map, height_area, v_world, r);
        vec3 walls = 0.30 * (sky_light + ground_light) + lights_on * vec3(0.10, 0.06, 0.03) + 0.25 * lamp;
        color = mix(color, mix(sky_gradient(normalize(r)), walls, hidden), clamp(share, 0.0, 0.9));
#ifdef LIT
        color += wet * lights_on * lamp_light * mirrored_lamps(v_world, r, 160.0);
#endif
    }
#endif
#ifdef WEATHER
    color = mix(fog_color + 0.35 * lamp, color, seen_through(distance_m));
#else
    color = mix(horizon_color(), color, seen_through(distance_m));
#endif

    out_color = vec4(toned(color), 1.0);
#ifdef WEATHER
    out_color.rgb = noised(out_color.rgb);
#endif
    out_depth = depth_here();
    out_tag = f_tag & 0xffff00ffu;
}
