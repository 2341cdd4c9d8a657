#version 330 core
// In place of pyrender's own: kind, id and layer travel with each vertex, in the tangent's place, which nothing else uses here.
layout(location = 0) in vec3 position;
layout(location = TANGENT_LOC) in vec4 in_tag;    // kind, id low byte, id high byte, what its layer moves the depth test by
layout(location = COLOR_0_LOC) in vec4 in_color;
layout(location = INST_M_LOC) in mat4 inst_m;

uniform mat4 P;
uniform mat4 V;
uniform mat4 M;
uniform vec3 cam_pos;

out float depth_m;
flat out vec3 tag;
flat out vec3 paint;

void main() {
    vec3 c = mat3(V) * ((M * inst_m * vec4(position, 1.0)).xyz - cam_pos);  // V as it stands would lose millimetres far out
    depth_m = -c.z;
    tag = in_tag.xyz;
    paint = in_color.rgb;
    gl_Position = P * vec4(c, 1.0);
    gl_Position.z += P[3][2] * (1.0 / (1.0 - in_tag.w) - 1.0);             // as if nearer by the layer
}
