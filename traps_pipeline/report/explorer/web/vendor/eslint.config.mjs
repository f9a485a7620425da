// The sources share one scope, in which the type checker looks for names.
const rules = [
  ...["eqeqeq", "no-cond-assign", "no-const-assign", "no-dupe-args", "no-dupe-keys", "no-duplicate-case", "no-empty"],
  ...["no-eval", "no-fallthrough", "no-implied-eval", "no-self-assign", "no-self-compare", "no-shadow-restricted-names"],
  ...["no-sparse-arrays", "no-unreachable", "no-unsafe-finally", "no-useless-escape", "no-var", "prefer-const"],
  ...["use-isnan", "valid-typeof"],
];

export default [
  { ignores: ["**/vendor/**"] },
  {
    languageOptions: { ecmaVersion: "latest", sourceType: "script" },
    rules: {
      ...Object.fromEntries(rules.map((name) => [name, "error"])),
      "no-unused-vars": ["error", { vars: "local", ignoreRestSiblings: true }],
    },
  },
];
