// Shared by the vertex shaders: one part's vertex from mesh to world. Positions are relative to the scene's origin.
in vec3 in_position;
in vec3 in_normal;
in vec3 in_center;
in vec3 in_half;
in vec4 in_quaternion;
in vec4 in_color;
in uint in_tag;
in float in_bias;

vec3 turned(vec4 q, vec3 v) { return v + 2.0 * cross(q.xyz, cross(q.xyz, v) + q.w * v); }
vec3 turned_back(vec4 q, vec3 v) { return turned(vec4(-q.xyz, q.w), v); }
